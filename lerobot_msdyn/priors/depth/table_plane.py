"""Depth without a sensor or learned weights: a table plane on which everything stands."""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import unproject_image

type Ground = Float[Tensor, "h w"]

# Distance of the wall behind the table, in distances to the table at the image's centre: shelves and monitors are
# nearer, rooms farther (benchmarks/notes/priors.md).
_WALL = 2.0
_LOWEST = 0.98  # quantile of an instance's rows where it touches the table; the very last ones may be stray pixels
_SMOOTH_FRAMES = 9  # of the temporal smoothing of an instance's distance


def table_plane(width: int, height: int, intrinsics: Float[Tensor, "3 3"], height_m: float, tilt_deg: float) -> Ground:
    """Assumed z-depth (m) where none is recorded: a table, and a wall behind it.

    The camera looks `tilt_deg` below the horizontal from `height_m` above the table, without roll.
    """
    tilt = math.radians(tilt_deg)
    y = (torch.arange(height) + 0.5 - intrinsics[1, 2].cpu()) / intrinsics[1, 1].cpu()
    descent = y * math.cos(tilt) + math.sin(tilt)  # of a ray, per metre of z
    wall = _WALL * height_m / math.sin(tilt)
    rows = torch.where(descent > height_m / wall, height_m / descent.clamp(min=1e-6), wall)
    return rows[:, None].repeat(1, width)


def ground_plane(camera: CameraTrack, ground_m: float) -> Ground:
    """As `table_plane`, for a fixed camera that is known to stand over the ground (z up, m)."""
    pose = camera.world_from_camera[0]
    rays = unproject_image(torch.ones(camera.height, camera.width), camera.intrinsics[0])
    descent = -(rays @ pose[2, :3])  # per metre of z
    above = (pose[2, 3] - ground_m).clamp(min=1e-3)
    centre = descent[camera.height // 2, camera.width // 2].clamp(min=0.1)
    wall = _WALL * above / centre
    return torch.where(descent > above / wall, above / descent.clamp(min=1e-6), wall)


def with_standing(
    ground: Ground | Float[Tensor, "t h w"],
    instances: UInt8[Tensor, "t h w"],
    empty: Float[Tensor, "h w"] | None = None,
) -> Float[Tensor, "t h w"]:
    """z-depth (m) of what keeps still and of upright things on the ground.

    A moving instance has one depth per frame, that of the ground under its lowest rows, smoothed over time. Plausible,
    not metric: what is lifted, or hides its own foot, is put too far away or too near.

    Args:
        ground: z-depth (m) of the ground, which may be another at every frame.
        instances: what moves.
        empty: z-depth (m) of all that keeps still; None: of the ground.
    """
    depth = (ground if empty is None else empty).expand(instances.shape)
    rows = ground.median(dim=-1).values.expand(instances.shape[:2])
    for instance in range(1, int(instances.max()) + 1):
        mask = instances == instance
        if bool(mask.any()):
            whole = mask | (without_holes(mask) & (instances == 0))  # masks miss spots that look like the table
            depth = torch.where(whole, _standing(mask, rows)[:, None, None], depth)
    return depth.contiguous()


def without_holes(mask: Bool[Tensor, "t h w"]) -> Bool[Tensor, "t h w"]:
    """Masks with what they enclose."""
    whole = mask.to(torch.uint8).numpy().copy()
    for frame in whole:
        outlines, _ = cv2.findContours(frame, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(frame, outlines, -1, 1, cv2.FILLED)
    return torch.from_numpy(whole).bool()


def _standing(mask: Bool[Tensor, "t h w"], rows: Float[Tensor, "t h"]) -> Float[Tensor, " t"]:
    """Depth (m) of an instance at every frame, from the row where it touches the table."""
    down_to_row = mask.sum(2).cumsum(1) / mask.sum((1, 2)).clamp(min=1)[:, None]
    foot = (down_to_row < _LOWEST).sum(1).clamp(max=rows.shape[1] - 1)
    seen = mask.any(2).any(1).nonzero()[:, 0].numpy()
    nearest = np.interp(np.arange(len(mask)), seen, rows[seen, foot[seen]].numpy()).astype(np.float32)
    reach = _SMOOTH_FRAMES // 2
    padded = torch.from_numpy(np.pad(nearest, 2 * reach, mode="edge"))
    median = padded.unfold(0, _SMOOTH_FRAMES, 1).median(dim=-1).values
    return median.unfold(0, _SMOOTH_FRAMES, 1).mean(dim=-1)
