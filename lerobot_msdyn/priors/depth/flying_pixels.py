"""Depth that no surface has: at the ends of a sensor's range, and between two surfaces (flying pixels)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_SUPPORT = 0.03  # relative difference up to which two neighbouring depths count as one surface
_MIN_SUPPORT = 3  # of the eight neighbours; a straight edge of a true surface has five, its corner three


def clean_recorded_depth(depth: Float[Tensor, "t h w"], depth_min: float, depth_max: float) -> Float[Tensor, "t h w"]:
    """Recorded z-depth (m) with everything that is no measurement set to 0.

    LeRobot stores depth in a bounded range: a missing pixel comes back as `depth_min` and a far one as `depth_max`
    (both up to rounding of the codec), so both ends are discarded, and then flying pixels.
    """
    inside = torch.isfinite(depth) & (depth > 1.5 * depth_min) & (depth < 0.99 * depth_max)
    return without_flying_pixels(torch.where(inside, depth, 0.0))


def without_flying_pixels(depth: Float[Tensor, "t h w"]) -> Float[Tensor, "t h w"]:
    """Depth (m, 0 = unknown) with 0 where fewer than three of the eight neighbours have about the same depth.

    That takes single outliers away, and the ramps by which networks and interpolation join two surfaces: along a ramp
    only the two neighbours of the same height agree.
    """
    return torch.stack([torch.where(_is_supported(frame), frame, 0.0) for frame in depth])


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
