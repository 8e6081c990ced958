"""What motion does not explain of a frame is shown at those around it as well, where they agree."""

import dataclasses

import pytest
import torch

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov, static_camera
from lerobot_msdyn.core.observations import DepthTraits, View
from lerobot_msdyn.motion.model.bases import MotionLevel, identity_level
from lerobot_msdyn.priors import PointTracks, Priors
from lerobot_msdyn.reconstruction.background import background_gaussians, pixel_gaussians
from lerobot_msdyn.reconstruction.make_overlay import overlay_of
from lerobot_msdyn.reconstruction.make_short_lived import short_lived_of
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.rendering import render_scene
from lerobot_msdyn.scene.short_lived import STILL
from lerobot_msdyn.scene.store import load_scene, save_scene

WIDTH, HEIGHT, FRAMES, REACH = 64, 48, 9, 2
NEAR, FAR = 0.8, 1.0  # m
SIDE, STEP = 14, 3  # px: of a square, half of which the scene knows, and how far it moves per frame
LAMP = (slice(36, 44), slice(4, 16))  # what stands still and is lit from LIT on; the scene does not know
LIT = 3
RED, YELLOW = torch.tensor([[200, 40, 40], [220, 200, 40]], dtype=torch.uint8)


def square(frame: int, rows: slice = slice(16, 16 + SIDE)) -> tuple[slice, slice]:
    return rows, slice(6 + STEP * frame, 6 + STEP * frame + SIDE)


@pytest.fixture
def recorded() -> tuple[DynamicScene, View, Priors]:
    """A red square moves before a wall, on which a lamp is lit; the scene has the upper half, and its motion, alone."""
    camera = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), FRAMES, WIDTH, HEIGHT)
    wall = torch.full((HEIGHT, WIDTH, 3), 120, dtype=torch.uint8)
    rgb, depth = wall.expand(FRAMES, -1, -1, -1).clone(), torch.full((FRAMES, HEIGHT, WIDTH), FAR)
    instances = torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.uint8)
    for frame in range(FRAMES):
        if frame >= LIT:
            rgb[frame, *LAMP] = YELLOW
        rgb[frame, *square(frame)] = RED
        depth[frame, *square(frame)], instances[frame, *square(frame)] = NEAR, 1
    none = torch.zeros(0, FRAMES)
    tracks = PointTracks(torch.zeros(0, FRAMES, 2), none.bool(), none, torch.zeros(0, dtype=torch.long))
    static = background_gaussians(wall, torch.full((HEIGHT, WIDTH), FAR), camera, 10_000)
    upper = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    upper[square(0, slice(16, 16 + SIDE // 2))] = True
    moving = pixel_gaussians(rgb[0], depth[0], camera, 0)[0].select(upper.reshape(-1))
    step = STEP * NEAR / float(camera.intrinsics[0, 0, 0])
    path = torch.stack((step * torch.arange(FRAMES), torch.zeros(FRAMES), torch.zeros(FRAMES)), dim=-1)
    still = identity_level(torch.zeros(1, 3), FRAMES)
    assert isinstance(still, MotionLevel)
    level = dataclasses.replace(still, displacements=path[None], active=torch.ones(1, dtype=torch.bool))
    rows = torch.zeros(len(moving), 1)
    scene = DynamicScene(static, moving, (level,), (rows.long(),), (rows,), FRAMES)
    return scene, View(rgb, camera), Priors(depth, instances, tracks, DepthTraits(metric=True))


def error(scene: DynamicScene, view: View, frame: int, where: tuple[slice, slice]) -> float:
    camera = view.camera.select([frame])
    picture = render_scene(scene, camera, torch.tensor([frame])).rgb[0]
    return float((picture - view.rgb[frame].float() / 255).abs().mean(-1)[where].mean())


def test_it_moves_as_what_is_nearest_does_or_stands_still(recorded: tuple[DynamicScene, View, Priors]) -> None:
    scene, view, priors = recorded
    lower = slice(16 + SIDE // 2 + 2, 16 + SIDE - 1)
    mended = dataclasses.replace(scene, short_lived=short_lived_of(scene, view, priors, REACH))
    for frame in range(FRAMES):
        assert error(scene, view, frame, square(frame, lower)) > 0.15
        assert error(mended, view, frame, square(frame, lower)) < 0.05, frame
        assert error(mended, view, frame, square(frame, slice(18, 20))) < 0.05, "the scene's own are not harmed"
    for frame in range(5, FRAMES):
        assert error(mended, view, frame, LAMP) < 0.6 * error(scene, view, frame, LAMP)
    assert error(mended, view, LIT - 2, LAMP) < 0.02, "it was not lit yet"
    short = mended.short_lived
    assert short is not None
    assert {STILL} < set(short.carrier.tolist())
    shown = short.shown.bincount(minlength=len(short.means))
    assert shown.min() >= 1
    assert shown.max() == 2 * REACH + 1


def test_the_overlay_shows_what_is_left(recorded: tuple[DynamicScene, View, Priors]) -> None:
    scene, view, priors = recorded
    short = dataclasses.replace(scene, short_lived=short_lived_of(scene, view, priors, REACH))
    alone, after = overlay_of(scene, view, priors), overlay_of(short, view, priors)
    assert len(after.means) < 0.6 * len(alone.means)
    both = dataclasses.replace(short, overlay=after)
    for frame in range(FRAMES):
        assert error(both, view, frame, square(frame)) < 0.05
        assert error(both, view, frame, LAMP) < 0.05
        patch, lasting = both.patch(frame), both.short_lived_patch(frame)
        assert patch is not None
        assert lasting is not None
        assert patch.short_lived <= len(lasting)
        assert len(patch) - patch.short_lived == len(range(*after.rows(frame).indices(len(after.means))))


def test_files_keep_it(recorded: tuple[DynamicScene, View, Priors], tmp_path_factory: pytest.TempPathFactory) -> None:
    scene, view, priors = recorded
    scene = dataclasses.replace(scene, short_lived=short_lived_of(scene, view, priors, REACH))
    path = tmp_path_factory.mktemp("short") / "scene.safetensors"
    save_scene(scene, path)
    frames = torch.arange(FRAMES)
    again = render_scene(load_scene(path), view.camera, frames).rgb
    assert torch.equal(again, render_scene(scene, view.camera, frames).rgb)


def test_nothing_is_added_where_all_is_explained(recorded: tuple[DynamicScene, View, Priors]) -> None:
    scene, view, priors = recorded
    wall = dataclasses.replace(view, rgb=torch.full_like(view.rgb, 120))
    alone = scene.select_moving(slice(0))
    flat = dataclasses.replace(priors, depth=torch.full_like(priors.depth, FAR))
    short = short_lived_of(alone, wall, flat, REACH)
    assert len(short.means) == 0
    camera: CameraTrack = view.camera.select([0])
    mended = render_scene(dataclasses.replace(alone, short_lived=short), camera, torch.tensor([0]))
    torch.testing.assert_close(mended.rgb, render_scene(alone, camera, torch.tensor([0])).rgb)
