"""The unit of poses from structure from motion, by depth: how far the camera goes is told by what it sees."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.corners import away_from, corners_followed
from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.priors.registry import Depth

_PAIRS = 40  # pairs of frames that are looked at
_APART = (0.05, 0.15)  # of the clip, from one frame of a pair to the other
_LEAST = 100  # corners, together, that must tell
_SURE = 0.3  # share of the corners, those that the shift moves most, that count


def scaled_to_depth(
    camera: CameraTrack, rgb: UInt8[Tensor, "t h w 3"], depth: Depth, instances: UInt8[Tensor, "t h w"]
) -> tuple[CameraTrack, float]:
    """The camera with shifts in the unit of the depth, and the factor by which they were multiplied.

    A corner with its depth is at X in one frame; in another the ray through it holds R X + s t, which gives s.

    Raises:
        EpisodeError: too few corners of known depth can be followed, or the camera only turns.
    """
    frames, gaps = len(camera), [max(1, round(share * len(camera))) for share in _APART]
    told: list[Float64[ndarray, "n 2"]] = []  # of each corner s, and how far it goes by a shift
    for gap in gaps:
        starts = np.unique(np.linspace(0, frames - 1 - gap, _PAIRS // len(gaps)).round().astype(int))
        told += [_factors(camera, rgb, depth, instances, int(start), int(start) + gap) for start in starts]
    factors, sure = np.concatenate(told).T
    chosen = sure >= np.quantile(sure, 1 - _SURE) if len(sure) else np.zeros(0, bool)
    factor = float(np.median(factors[chosen])) if chosen.sum() >= _LEAST else 0.0
    if not factor > 0:
        raise EpisodeError(
            f"the unit of the camera's poses cannot be told from depth: {len(factors)} corners of known depth could be "
            f"followed, expected {_LEAST} or more that go by parallax; give poses in metres by --camera.poses FILE.npz"
        )
    poses = camera.world_from_camera.clone()
    poses[:, :3, 3] *= factor
    return replace(camera, world_from_camera=poses), factor


def _factors(
    camera: CameraTrack,
    rgb: UInt8[Tensor, "t h w 3"],
    depth: Depth,
    instances: UInt8[Tensor, "t h w"],
    one: int,
    other: int,
) -> Float64[ndarray, "n 2"]:
    """Of each corner of a frame that is found in another: the factor, and the weight by which to trust it."""
    grey = [cv2.cvtColor(rgb[frame].numpy(), cv2.COLOR_RGB2GRAY) for frame in (one, other)]
    corners, followed = corners_followed(grey[0], grey[1], away_from((instances[one] > 0).numpy()))
    row, column = corners.astype(int)[:, ::-1].T
    z = depth.z[one].numpy()[row, column].astype(np.float64)
    corners, followed, z = corners[z > 0] + 0.5, followed[z > 0] + 0.5, z[z > 0]
    k = [camera.intrinsics[frame].double().numpy() for frame in (one, other)]
    ones = np.ones((len(z), 1))
    points = np.concatenate((corners, ones), axis=1) @ np.linalg.inv(k[0]).T * z[:, None]
    rays = np.concatenate((followed, ones), axis=1) @ np.linalg.inv(k[1]).T
    pose = (camera.camera_from_world[other].double() @ camera.world_from_camera[one].double()).numpy()
    turned = np.cross(rays, points @ pose[:3, :3].T)
    shifted = np.cross(rays, pose[:3, 3])
    size = (shifted**2).sum(1)
    return np.stack((-(turned * shifted).sum(1) / size.clip(min=1e-12), np.sqrt(size) / z), axis=1)
