"""Tracks in the image become tracks in the world."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import nearest_pixel, transform_points, unproject
from lerobot_msdyn.core.observations import BodyTracks, PointTracks
from lerobot_msdyn.core.sampling import scaled_px

_EDGE_JUMP = 0.05  # relative difference of neighbouring depths that makes an edge
_EDGE_MARGIN_PX = 2  # of 320
_DEPTH_WINDOW = 5  # frames over which a track's depth is smoothed
_NORMAL_MAD = 1.4826  # standard deviations in the median absolute deviation of a normal distribution


@dataclass(frozen=True)
class LiftedTracks:
    """Tracks in the world."""

    xyz: Float[Tensor, "n t 3"]  # m; meaningless where not valid
    valid: Bool[Tensor, "n t"]
    confidence: Float[Tensor, "n t"]  # 0..1
    instance: Int[Tensor, " n"]
    pixel_m: float  # size of a pixel of a picture 320 wide, where they are
    body: Int[Tensor, " n"] | None = None  # rigid body of each whose motion is known, in all frames; else -1

    def followed_by(self, bodies: BodyTracks) -> "LiftedTracks":
        """With the points of bodies in place of the tracks of their instance."""
        kept = self.instance != bodies.instance
        known = torch.full((len(bodies.body),), bodies.instance).to(self.instance)
        return LiftedTracks(
            torch.cat((self.xyz[kept], bodies.xyz)),
            torch.cat((self.valid[kept], bodies.visible)),
            torch.cat((self.confidence[kept], bodies.visible.to(self.confidence))),
            torch.cat((self.instance[kept], known)),
            self.pixel_m,
            torch.cat((torch.full((int(kept.sum()),), -1), bodies.body)),
        )


def lift_tracks(
    tracks: PointTracks, depth: Float[Tensor, "t h w"], camera: CameraTrack
) -> tuple[Float[Tensor, "n t 3"], Bool[Tensor, "n t"]]:
    """World positions (m) of tracked points, and where they can be relied on.

    Needs visibility, a known depth and 2 px of distance from a depth edge. Each track's depth is that of a robust
    line through five frames: noise along the ray dominates. From a teleport on, the shorter side of a track is dropped.
    Positions that are not valid are zero.
    """
    n, frames = tracks.visible.shape
    if n == 0:
        return torch.zeros(0, frames, 3), torch.zeros(0, frames, dtype=torch.bool)
    edges = torch.from_numpy(np.stack([near_depth_edge(d) for d in depth.cpu().numpy()]))
    row, column = nearest_pixel(tracks.xy, depth.shape[2], depth.shape[1])
    time = torch.arange(frames).expand(n, -1)
    z = depth.cpu()[time, row, column]
    valid = tracks.visible & (z > 0) & ~edges[time, row, column]
    z = _smooth_over_time(z, valid)
    in_camera = unproject(tracks.xy.transpose(0, 1).contiguous(), z.T, camera.intrinsics)
    xyz = transform_points(camera.world_from_camera, in_camera).transpose(0, 1).contiguous()
    valid = _without_teleports(xyz, valid, tracks.instance)
    return torch.where(valid[..., None], xyz, 0.0), valid


def position_noise(xyz: Float[Tensor, "n t 3"], valid: Bool[Tensor, "n t"]) -> float:
    """Standard deviation (m) of lifted positions along one axis, from second differences over time; 0 if none."""
    triple = valid[:, :-2] & valid[:, 1:-1] & valid[:, 2:]
    second = (xyz[:, :-2] - 2 * xyz[:, 1:-1] + xyz[:, 2:])[triple]
    if len(second) == 0:
        return 0.0
    return float(_NORMAL_MAD * second.abs().median() / 6**0.5)


def near_depth_edge(depth: Float32[ndarray, "h w"], margin_px: int = _EDGE_MARGIN_PX) -> Bool[ndarray, "h w"]:
    """Pixels within `margin_px` (of a picture 320 wide; at least 1) of a depth edge; unknown depth is no edge."""
    measured = depth > 0
    window = np.ones((3, 3), np.uint8)
    far = cv2.dilate(np.where(measured, depth, 0).astype(np.float32), window)
    near = cv2.erode(np.where(measured, depth, np.inf).astype(np.float32), window)
    edge = (far / (1 + _EDGE_JUMP) > near).astype(np.uint8)
    reach = max(1, round(scaled_px(margin_px, depth.shape[1])))
    side = 2 * reach - 1  # the window above reaches one pixel already
    return cv2.dilate(edge, np.ones((side, side), np.uint8)) > 0


def _smooth_over_time(z: Float[Tensor, "n t"], valid: Bool[Tensor, "n t"]) -> Float[Tensor, "n t"]:
    """Robust line (Theil-Sen) through the valid entries of a window, at its middle; zero where there is none.

    A median alone would lag behind what moves along the ray, the more so where entries of the window are missing.
    """
    reach = _DEPTH_WINDOW // 2
    padded = torch.nn.functional.pad(torch.where(valid, z, torch.nan), (reach, reach), value=torch.nan)
    window = padded.unfold(1, _DEPTH_WINDOW, 1)
    offset = torch.arange(-reach, reach + 1).to(z)
    first, second = torch.triu_indices(_DEPTH_WINDOW, _DEPTH_WINDOW, 1)
    slopes = (window[..., second] - window[..., first]) / (offset[second] - offset[first])
    slope = torch.where(window.isfinite().sum(-1) >= 3, slopes.nanmedian(dim=-1).values, 0.0)
    return (window - slope[..., None] * offset).nanmedian(dim=-1).values.nan_to_num(0.0)


def _without_teleports(
    xyz: Float[Tensor, "n t 3"], valid: Bool[Tensor, "n t"], instance: Tensor
) -> Bool[Tensor, "n t"]:
    """Drop the shorter side of every track that jumps.

    A jump is a step far longer than those of the fast part (90 %) of its instance at the same frame: measured against
    its own past, every object would seem to jump when it starts to move.
    """
    valid = valid.clone()
    steps = (xyz[:, 1:] - xyz[:, :-1]).norm(dim=-1)
    both = valid[:, 1:] & valid[:, :-1]
    noise = position_noise(xyz, valid)
    for label in instance.unique():
        rows = instance == label
        usual = torch.where(both[rows], steps[rows], torch.nan).nanquantile(0.9, dim=0).nan_to_num(0.0)
        jumps = both[rows] & (steps[rows] > 3 * usual + 6 * noise)
        for track, frame in zip(*(i.tolist() for i in jumps.nonzero(as_tuple=True)), strict=True):
            line = valid[rows.nonzero()[track, 0]]
            shorter = line[: frame + 1] if line[: frame + 1].sum() < line[frame + 1 :].sum() else line[frame + 1 :]
            shorter[:] = False
    return valid
