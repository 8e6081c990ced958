"""One factor of all depths, fitted to true views: what is only of the wrong size, and what is of the wrong shape."""

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov, static_camera
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.evaluate.scale import HeldOut, at_scale, fitted_scale
from lerobot_msdyn.evaluate.scores import SEEN, TrueViews

WIDTH, HEIGHT, FRAMES, DEPTH_M = 64, 48, 5, 2.0
RECORDED = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), FRAMES, WIDTH, HEIGHT)
TEXTURE = np.random.default_rng(0).uniform(0, 255, (40, 3))


def beside(shift_m: float) -> CameraTrack:
    poses = RECORDED.world_from_camera.clone()
    poses[:, 0, 3] += shift_m
    return CameraTrack(RECORDED.intrinsics, poses, WIDTH, HEIGHT)


def wall(camera: CameraTrack, depth_m: float) -> np.ndarray:
    """A wall before the recorded camera, that a camera beside it sees shifted."""
    focal = float(camera.intrinsics[0, 0, 0])
    pictures = []
    for pose in camera.world_from_camera:
        column = (np.arange(WIDTH) - WIDTH / 2) * depth_m / focal + float(pose[0, 3])
        at = (column / (0.15 * depth_m) + 20).clip(0, len(TEXTURE) - 1)  # the texture grows with the wall
        low = np.floor(at).astype(int).clip(0, len(TEXTURE) - 2)
        row = TEXTURE[low] + (at - low)[:, None] * (TEXTURE[low + 1] - TEXTURE[low])
        pictures.append(np.repeat(row[None], HEIGHT, axis=0))
    return np.stack(pictures).round().astype(np.uint8)


def views(*shifts_m: float) -> list[HeldOut]:
    seen = np.full((FRAMES, HEIGHT, WIDTH), SEEN, np.uint8)
    return [HeldOut(beside(m), torch.arange(FRAMES), TrueViews(wall(beside(m), DEPTH_M), seen)) for m in shifts_m]


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.7])
def test_the_factor_of_a_scene_of_the_wrong_size_is_found(factor: float) -> None:
    found = fitted_scale(RECORDED, views(0.2, -0.15), lambda view, camera: wall(camera, DEPTH_M / factor))
    assert found == pytest.approx(factor, rel=0.02)


def test_at_the_right_scale_a_wrong_scene_shows_the_truth() -> None:
    [view] = views(0.2)
    camera = at_scale(view.camera, RECORDED, view.frames, 2.0)
    assert camera.world_from_camera[:, 0, 3].tolist() == pytest.approx([0.1] * FRAMES)
    assert np.abs(wall(camera, DEPTH_M / 2).astype(int) - view.truth.rgb).max() <= 1
    assert view.camera.world_from_camera[0, 0, 3].item() == pytest.approx(0.2)


def test_a_recorded_camera_that_moves_is_refused() -> None:
    poses = RECORDED.world_from_camera.clone()
    poses[1, 0, 3] = 0.1
    moving = CameraTrack(RECORDED.intrinsics, poses, WIDTH, HEIGHT)
    with pytest.raises(ConfigError, match="fit_scale is true, but the recorded camera moves"):
        fitted_scale(moving, views(0.2), lambda view, camera: wall(camera, DEPTH_M))
