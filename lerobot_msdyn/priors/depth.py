"""Depth without learned weights: cleaned sensor depth, or a table plane on which everything stands."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

_SUPPORT = 0.03  # relative difference up to which two neighbouring depths count as one surface
_MIN_SUPPORT = 3  # of the eight neighbours; a straight edge of a true surface has five, its corner three
_WALL = 3.0  # distance of the wall behind the table, in distances to the table at the image's centre
_LOWEST = 0.98  # quantile of an instance's rows where it touches the table; the very last ones may be stray pixels
_SMOOTH_FRAMES = 9  # of the temporal smoothing of an instance's distance
_STATIC_SAMPLES = 60  # frames over which a static median is taken
_ALIGN_SAMPLES = 20_000  # pixels of a clip that an alignment looks at
_ALIGN_STEPS = 20


def clean_recorded_depth(depth: Float[Tensor, "t h w"], depth_min: float, depth_max: float) -> Float[Tensor, "t h w"]:
    """Recorded z-depth (m) with everything that is no measurement set to 0.

    LeRobot stores depth in a bounded range: a missing pixel comes back as `depth_min` and a far one as `depth_max`
    (both up to rounding of the codec), so both ends are discarded. Flying pixels, between two surfaces, are found by
    having fewer than three neighbours of their own depth.
    """
    inside = torch.isfinite(depth) & (depth > 1.5 * depth_min) & (depth < 0.99 * depth_max)
    cleaned = torch.where(inside, depth, 0.0)
    return torch.stack([torch.where(_is_supported(frame), frame, 0.0) for frame in cleaned])


def _is_supported(depth: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Pixels with enough neighbours of their own depth; a neighbour outside the image counts as one."""
    height, width = depth.shape
    padded = torch.nn.functional.pad(depth[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    support = torch.zeros(height, width, dtype=torch.int8)
    for y in range(3):
        for x in range(3):
            if (y, x) != (1, 1):
                neighbour = padded[y : y + height, x : x + width]
                support += (neighbour - depth).abs() < _SUPPORT * depth
    return support >= _MIN_SUPPORT


def table_plane_depth(
    instances: UInt8[Tensor, "t h w"], intrinsics: Float[Tensor, "3 3"], height_m: float, tilt_deg: float
) -> Float[Tensor, "t h w"]:
    """Assumed z-depth (m) where none is recorded: a table, a wall behind it, and upright things on the table.

    The camera looks `tilt_deg` below the horizontal from `height_m` above the table, without roll. A moving instance
    has one depth per frame, that of the table under its lowest rows, smoothed over time. Plausible, not metric: what
    is lifted off the table, or hides its own foot, is put too far away or too near.
    """
    frames, height, width = instances.shape
    tilt = math.radians(tilt_deg)
    y = (torch.arange(height) + 0.5 - intrinsics[1, 2].cpu()) / intrinsics[1, 1].cpu()
    descent = y * math.cos(tilt) + math.sin(tilt)  # of a ray, per metre of z
    wall = _WALL * height_m / math.sin(tilt)
    rows = torch.where(descent > height_m / wall, height_m / descent.clamp(min=1e-6), wall)
    depth = rows[None, :, None].repeat(frames, 1, width)
    for instance in range(1, int(instances.max()) + 1):
        mask = instances == instance
        if bool(mask.any()):
            depth = torch.where(mask, _standing(mask, rows)[:, None, None], depth)
    return depth


def _standing(mask: Bool[Tensor, "t h w"], rows: Float[Tensor, " h"]) -> Float[Tensor, " t"]:
    """Depth (m) of an instance at every frame, from the row where it touches the table."""
    share = mask.sum(2).cumsum(1) / mask.sum((1, 2)).clamp(min=1)[:, None]
    foot = (share < _LOWEST).sum(1).clamp(max=len(rows) - 1)
    seen = mask.any(2).any(1).nonzero()[:, 0].numpy()
    nearest = np.interp(np.arange(len(mask)), seen, rows[foot[seen]].numpy()).astype(np.float32)
    reach = _SMOOTH_FRAMES // 2
    padded = torch.from_numpy(np.pad(nearest, 2 * reach, mode="edge"))
    median = padded.unfold(0, _SMOOTH_FRAMES, 1).median(dim=-1).values
    return median.unfold(0, _SMOOTH_FRAMES, 1).mean(dim=-1)


def static_depth(depth: Float[Tensor, "t h w"], instances: UInt8[Tensor, "t h w"]) -> Float[Tensor, "h w"]:
    """Depth (m) of the empty scene: per pixel the median over frames in which nothing moves there; 0 where never."""
    frames = len(depth)
    sample = torch.linspace(0, frames - 1, min(frames, _STATIC_SAMPLES)).round().long()
    empty = _static_median(depth[sample].flatten(1), instances[sample].flatten(1))
    missing = empty == 0
    if frames > len(sample) and missing.any():
        empty[missing] = _static_median(depth.flatten(1)[:, missing], instances.flatten(1)[:, missing])
    return empty.reshape(depth.shape[1:])


def _static_median(depth: Float[Tensor, "t p"], instances: UInt8[Tensor, "t p"]) -> Float[Tensor, " p"]:
    usable = (instances == 0) & (depth > 0)
    return torch.where(usable, depth, torch.nan).nanmedian(dim=0).values.nan_to_num(0.0)


def align_disparity(disparity: Float[Tensor, "t h w"], reference: Float[Tensor, "t h w"]) -> Float[Tensor, "t h w"]:
    """Depth (m) of relative inverse depth, by one robust scale and shift per clip against a reference depth (m).

    Least absolute differences of inverse depth, by iterated reweighting. Depth is bounded by twice the reference's
    largest, which also takes care of inverse depths that come out negative. Where the two disagree so much that
    the scale would not be positive, the disparity is of no use and the reference is returned.
    """
    usable = (reference > 0) & torch.isfinite(disparity)
    x, y = disparity[usable].double(), reference[usable].double().reciprocal()
    if len(x) == 0:
        return reference
    stride = max(1, len(x) // _ALIGN_SAMPLES)
    x, y = x[::stride], y[::stride]
    design = torch.stack((x, torch.ones_like(x)), dim=1)
    weights = torch.ones_like(x)
    for _ in range(_ALIGN_STEPS):
        root = weights.sqrt()[:, None]
        scale, shift = torch.linalg.lstsq(design * root, y[:, None] * root).solution[:, 0].tolist()
        weights = (design @ torch.tensor([scale, shift], dtype=x.dtype) - y).abs().clamp(min=1e-4).reciprocal()
    if scale <= 0:
        return reference
    inverse = (scale * disparity + shift).clamp(min=0.5 / float(reference.max()))
    return torch.where(torch.isfinite(disparity), inverse.reciprocal(), 0.0)
