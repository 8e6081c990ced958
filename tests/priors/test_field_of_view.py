"""The field of view at which rigid things keep their size."""

import math

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import PointTracks
from lerobot_msdyn.priors.camera.field_of_view import fov_from_rigid_motion

T, H, W, FOV = 40, 240, 320, 48.0
CAMERA = static_camera(intrinsics_from_fov(W, H, 70.0), T, W, H)  # what is assumed; its focal length is not used


def turning_block(turn_deg: float, noise_px: float = 0.2) -> tuple[PointTracks, np.ndarray]:
    """Points of a slab that turns while it slides, and the depth that a camera of 48 degrees sees."""
    generator = np.random.default_rng(0)
    points = generator.uniform((-0.2, -0.02, -0.1), (0.2, 0.02, 0.1), (300, 3))
    focal = float(intrinsics_from_fov(W, H, FOV)[0, 0])
    xy, depth = np.zeros((300, T, 2), np.float32), np.zeros((T, H, W), np.float32)
    for t in range(T):
        angle = math.radians(turn_deg) * t / (T - 1)
        turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
        at = points @ turn.T + (0.1 * t / T, 0, 1.0)
        pixel = focal * at[:, :2] / at[:, 2:] + (W / 2, H / 2)
        depth[t, pixel[:, 1].astype(int), pixel[:, 0].astype(int)] = at[:, 2]
        xy[:, t] = pixel
    seen = depth[np.arange(T), xy[..., 1].astype(int), xy[..., 0].astype(int)] > 0
    xy += noise_px * generator.normal(size=xy.shape).astype(np.float32)
    ones = torch.ones(300, T)
    return PointTracks(torch.from_numpy(xy), torch.from_numpy(seen), ones, torch.ones(300, dtype=torch.int64)), depth


def test_a_turning_thing_tells() -> None:
    fov, correlation = fov_from_rigid_motion(*turning_block(50.0, noise_px=0.0), CAMERA)
    assert fov == pytest.approx(FOV, abs=2)
    assert correlation > 0.9


def test_a_sliding_thing_does_not() -> None:
    with pytest.raises(PriorError, match="nothing rigid turns enough"):
        fov_from_rigid_motion(*turning_block(0.0), CAMERA)


def test_without_tracks_nothing_tells() -> None:
    tracks, depth = turning_block(50.0)
    none = torch.zeros(0, dtype=torch.int64)
    empty = PointTracks(tracks.xy[none], tracks.visible[none], tracks.confidence[none], tracks.instance[none])
    with pytest.raises(PriorError, match="cannot be found"):
        fov_from_rigid_motion(empty, depth, CAMERA)
