"""What stands still is shown as a backdrop as it is among all Gaussians."""

import dataclasses

import pytest
import torch

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov, static_camera
from lerobot_msdyn.motion.model.bases import identity_level
from lerobot_msdyn.reconstruction.background import background_gaussians, pixel_gaussians
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.overlay import FramePatch, packed
from lerobot_msdyn.scene.rendering import render_scene
from lerobot_msdyn.scene.shading import Shading
from lerobot_msdyn.views.offsets import orbit_offset

WIDTH, HEIGHT, FRAMES = 64, 48, 3


@pytest.fixture
def camera() -> CameraTrack:
    """One that has been moved, so that not all is seen from where it stands."""
    camera = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), FRAMES, WIDTH, HEIGHT)
    pose = camera.world_from_camera[0] @ orbit_offset(8.0, 4.0, 1.0)
    return dataclasses.replace(camera, world_from_camera=pose.expand(FRAMES, 4, 4).contiguous())


@pytest.fixture
def scene() -> DynamicScene:
    """A wall whose brightness changes, a square before it that moves, and pixels of single frames that hide both."""
    generator = torch.Generator().manual_seed(0)
    recorded = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), 1, WIDTH, HEIGHT)
    picture = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=generator, dtype=torch.uint8)
    static = background_gaussians(picture, torch.full((HEIGHT, WIDTH), 1.0), recorded, 10_000)
    where = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    where[10:30, 20:44] = True
    moving = pixel_gaussians(picture, torch.full((HEIGHT, WIDTH), 0.8), recorded, 0, where=where)[0]
    level = dataclasses.replace(identity_level(torch.zeros(1, 3), FRAMES), active=torch.ones(1, dtype=torch.bool))
    level.displacements[0, :, 0] = torch.linspace(0, 0.1, level.displacements.shape[1])
    rows, own = torch.zeros(len(moving), 1), len(static) + len(moving)
    hidden = [torch.arange(own) % 7 == frame for frame in range(FRAMES)]
    shown = [moving.select(torch.arange(len(moving)) % 5 == frame) for frame in range(FRAMES)]
    overlay = [FramePatch(a.means - 0.1, a.quats, a.log_scales, a.rgb, b) for a, b in zip(shown, hidden, strict=True)]
    shading = Shading(
        torch.randint(90, 170, (FRAMES, 6, 8), generator=generator, dtype=torch.uint8),
        torch.rand(len(static), 2, generator=generator) * 2 - 1,
        torch.randint(90, 170, (FRAMES, len(moving)), generator=generator, dtype=torch.uint8),
    )
    bound = ((level,), (rows.long(),), (rows,))
    return DynamicScene(static, moving, *bound, frames=FRAMES, shading=shading, overlay=packed(overlay))


@pytest.mark.parametrize("patches", [True, False])
@pytest.mark.parametrize("once", [True, False])
def test_pictures_are_the_same(scene: DynamicScene, camera: CameraTrack, patches: bool, once: bool) -> None:
    scene = scene if patches else scene.without_patches()
    still = scene.still_view(camera, once=once)
    frames, extra = torch.arange(FRAMES), torch.linspace(1, 5, len(scene.moving))
    expected = render_scene(scene, camera, frames, extra=extra)
    for name, values in vars(render_scene(scene, camera, frames, extra=extra, still=still)).items():
        torch.testing.assert_close(values, getattr(expected, name), atol=0, rtol=0)
    assert (expected.rgb[0] - expected.rgb[2]).abs().max() > 0.05
    alone = scene.still()
    drawn = render_scene(alone, camera, frames, still=still)
    assert torch.equal(drawn.rgb, render_scene(alone, camera, frames).rgb)
