"""What renders a pixel: the background, motion, or recorded pixels; and which pixels count as moving."""

import dataclasses

import pytest
import torch

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov, static_camera
from lerobot_msdyn.motion.model.bases import identity_level
from lerobot_msdyn.reconstruction.background import background_gaussians, pixel_gaussians
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.overlay import FramePatch, packed
from lerobot_msdyn.scene.rendering import render_patched_together, render_scene
from lerobot_msdyn.scene.sources import MovingPixels, moving_pixels_of_view, sources_of
from lerobot_msdyn.views.offsets import orbit_offset

WIDTH, HEIGHT, FRAMES = 64, 48, 2
NEAR, FAR = 0.8, 1.0  # m
BY_MOTION, BY_OVERLAY = (slice(4, 20), slice(6, 22)), (slice(28, 44), slice(34, 54))  # what moves
SHADOW = (slice(28, 44), slice(6, 22))  # mended by the overlay, and still
MISSED = (slice(4, 20), slice(44, 60))  # moves, and only the background is there
AREA = 16 * 16


def region(*parts: tuple[slice, slice]) -> torch.Tensor:
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    for part in parts:
        mask[part] = True
    return mask


@pytest.fixture
def camera() -> CameraTrack:
    return static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), FRAMES, WIDTH, HEIGHT)


@pytest.fixture
def scene(camera: CameraTrack) -> DynamicScene:
    """A wall; before it a square that motion has, and at frame 1 recorded pixels of another one and of a shadow."""
    picture, wall = torch.full((HEIGHT, WIDTH, 3), 120, dtype=torch.uint8), torch.full((HEIGHT, WIDTH), FAR)
    depth = torch.where(region(BY_MOTION, BY_OVERLAY), NEAR, FAR)
    pixels = pixel_gaussians(picture, depth, camera, 0)[0]
    moving = pixels.select(region(BY_MOTION).reshape(-1))
    shown = pixels.select(region(BY_OVERLAY, SHADOW).reshape(-1))
    static = background_gaussians(picture, wall, camera, 10_000)
    hidden = torch.zeros(len(static) + len(moving), dtype=torch.bool)
    empty = shown.select(slice(0, 0))
    patches = [FramePatch(part.means, part.quats, part.log_scales, part.rgb, hidden) for part in (empty, shown)]
    rows = torch.zeros(len(moving), 1)
    level = identity_level(torch.zeros(1, 3), FRAMES)
    return DynamicScene(static, moving, (level,), (rows.long(),), (rows,), FRAMES, overlay=packed(patches))


def test_frames_rendered_together_look_as_one_by_one(scene: DynamicScene, camera: CameraTrack) -> None:
    frames, extra = torch.arange(FRAMES), torch.linspace(1, 5, len(scene.moving))
    patches = [patch for frame in range(FRAMES) if (patch := scene.patch(frame)) is not None]
    assert len({len(patch) for patch in patches}) == FRAMES
    together = render_patched_together(scene, camera, frames, patches, extra=extra)
    for name, values in vars(render_scene(scene, camera, frames, extra=extra)).items():
        torch.testing.assert_close(getattr(together, name), values, atol=1e-5, rtol=1e-5)


def test_every_pixel_knows_what_renders_it(scene: DynamicScene, camera: CameraTrack) -> None:
    sources = sources_of(scene, camera, torch.arange(FRAMES))
    assert (sources.motion + sources.overlay + sources.background).max() <= 1 + 1e-4
    inner = (slice(8, 16), slice(10, 18))
    assert sources.motion[:, *inner].min() > 0.9
    assert sources.overlay[1, 32:40, 38:50].min() > 0.9
    assert sources.overlay[0].max() == 0
    assert sources.background[0][~region(BY_MOTION)].median() > 0.9


def test_moving_pixels_are_those_of_the_mask_whatever_renders_them(scene: DynamicScene, camera: CameraTrack) -> None:
    mask = region(BY_MOTION, BY_OVERLAY, MISSED).expand(FRAMES, -1, -1)
    first, second = (sources_of(scene, camera.select([t]), torch.tensor([t])).count(mask[t : t + 1]) for t in (0, 1))
    assert first.total == second.total == int(mask[0].sum())
    assert first.overlay == 0
    assert first.motion == pytest.approx(AREA, abs=16)
    assert second.motion == pytest.approx(AREA, abs=16)
    assert second.overlay == pytest.approx(320, abs=16)  # and not the shadow, which does not move
    assert second.background == pytest.approx(AREA, abs=32)
    assert (first + second).total == 2 * first.total
    assert sum((first + second).shares.values()) == pytest.approx(1)


def test_a_new_view_has_moving_pixels_without_a_mask_of_its_own(scene: DynamicScene, camera: CameraTrack) -> None:
    elsewhere = dataclasses.replace(camera, world_from_camera=orbit_offset(4.0, 2.0, FAR).expand(FRAMES, 4, 4))
    larger, both = elsewhere.resized(2 * WIDTH, 2 * HEIGHT), torch.arange(FRAMES)
    mask = region(BY_MOTION, BY_OVERLAY).expand(FRAMES, -1, -1)
    for new, scale in ((elsewhere, 1), (larger, 4)):
        found = moving_pixels_of_view(scene, new, both, camera, mask)
        assert found.motion == pytest.approx(scale * 2 * AREA, rel=0.15)  # of two frames
        assert found.overlay == pytest.approx(scale * 320, rel=0.2)  # its border spills over
        assert found.background == 0
    # What the mask calls still is not moving, also where an overlay shows it.
    still = moving_pixels_of_view(scene, elsewhere, both, camera, torch.zeros_like(mask))
    assert still.overlay == 0
    assert still.motion == pytest.approx(2 * AREA, rel=0.15)
    alone = moving_pixels_of_view(dataclasses.replace(scene, overlay=None), elsewhere, both, camera, mask)
    assert alone.overlay == 0


def test_nothing_moves() -> None:
    assert MovingPixels().shares == {"by_motion": 0, "by_short_lived": 0, "by_overlay": 0, "by_background": 0}
