"""A picture that is drawn larger than it was fitted has no gaps between its Gaussians."""

import dataclasses

import pytest
import torch

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov, static_camera
from lerobot_msdyn.motion.model.bases import identity_level
from lerobot_msdyn.reconstruction.antialias import enlarged
from lerobot_msdyn.reconstruction.background import background_gaussians
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import isotropic
from lerobot_msdyn.scene.overlay import FramePatch, packed
from lerobot_msdyn.scene.rendering import render_scene

WIDTH, HEIGHT, RATIO = 32, 24, 5.0
FAR, SHRUNK = 1.3, 0.3  # m; of a pixel's Gaussian, as a fit makes it that has to reckon with the low-pass filter


@pytest.fixture
def camera() -> CameraTrack:
    return static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), 1, WIDTH, HEIGHT)


@pytest.fixture
def wall(camera: CameraTrack) -> DynamicScene:
    """A light wall of small Gaussians, one per pixel of the camera."""
    grey, depth = torch.full((HEIGHT, WIDTH, 3), 200, dtype=torch.uint8), torch.full((HEIGHT, WIDTH), FAR)
    static = background_gaussians(grey, depth, camera, WIDTH * HEIGHT)
    static = dataclasses.replace(static, log_scales=static.log_scales + torch.tensor(SHRUNK).log())
    none = torch.zeros(0, 1)
    level = identity_level(torch.zeros(1, 3), 1)
    return DynamicScene(static, static.select(slice(0)), (level,), (none.long(),), (none,), 1)


def inside(scene: DynamicScene, camera: CameraTrack, ratio: float) -> torch.Tensor:
    """Opacity of a picture that many times as large, without its border."""
    larger = camera.resized(round(ratio * WIDTH), round(ratio * HEIGHT))
    border = round(3 * ratio)
    return render_scene(scene, larger, torch.tensor([0])).alpha[0, border:-border, border:-border]


def test_gaps_close(wall: DynamicScene, camera: CameraTrack) -> None:
    assert inside(wall, camera, RATIO).std() > 0.1
    assert inside(enlarged(wall, camera, RATIO), camera, RATIO).std() < 0.02


def test_shows_at_the_pixels_of_the_fit_what_they_showed(wall: DynamicScene, camera: CameraTrack) -> None:
    middles = inside(enlarged(wall, camera, RATIO), camera, RATIO)[2::5, 2::5]
    assert (middles - inside(wall, camera, 1.0)).abs().max() < 0.01


def test_isotropic_gaussians_stay_so(wall: DynamicScene, camera: CameraTrack) -> None:
    balls = dataclasses.replace(wall, static=isotropic(wall.static))
    assert enlarged(balls, camera, RATIO).static.log_scales.shape == (len(wall.static), 1)


def test_nothing_changes_at_the_fitted_size(wall: DynamicScene, camera: CameraTrack) -> None:
    assert enlarged(wall, camera, 1.0) is wall


def test_overlays_grow_as_the_rest_does(wall: DynamicScene, camera: CameraTrack) -> None:
    static = wall.static
    shown = FramePatch(
        static.means, static.quats, static.log_scales, static.rgb, torch.ones(len(static), dtype=torch.bool)
    )
    larger = enlarged(dataclasses.replace(wall, overlay=packed([shown])), camera, RATIO)
    assert larger.overlay is not None
    assert torch.allclose(larger.overlay.log_scales.float(), larger.static.log_scales, atol=0.01)
    assert inside(larger, camera, RATIO).std() < 0.02


def test_behind_the_camera_nothing_grows(wall: DynamicScene, camera: CameraTrack) -> None:
    behind = dataclasses.replace(wall, static=dataclasses.replace(wall.static, means=-wall.static.means))
    assert torch.allclose(enlarged(behind, camera, RATIO).static.log_scales, wall.static.log_scales)
