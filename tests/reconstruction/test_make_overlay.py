"""What motion does not explain is shown as it was recorded: at its frame, at its place, and from elsewhere too."""

import dataclasses
from pathlib import Path

import pytest
import torch

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov, static_camera
from lerobot_msdyn.core.observations import DepthTraits, View
from lerobot_msdyn.motion.model.bases import identity_level
from lerobot_msdyn.priors import PointTracks, Priors
from lerobot_msdyn.reconstruction.background import background_gaussians, pixel_gaussians
from lerobot_msdyn.reconstruction.make_overlay import overlay_of
from lerobot_msdyn.reconstruction.unexplained import wrong_pixels
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.rendering import Rendering, render_scene
from lerobot_msdyn.scene.store import load_scene, save_scene
from lerobot_msdyn.views.offsets import orbit_offset

WIDTH, HEIGHT, FRAMES = 64, 48, 4
NEAR, FAR = 0.8, 1.0  # m
SIDE = 14  # px, of a square that moves by 8 px per frame


def square(frame: int) -> tuple[slice, slice]:
    return slice(16, 16 + SIDE), slice(8 + 8 * frame, 8 + 8 * frame + SIDE)


@pytest.fixture
def recorded() -> tuple[DynamicScene, View, Priors]:
    """A grey wall and a red square that moves before it; the scene believes that the square stands still."""
    camera = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), FRAMES, WIDTH, HEIGHT)
    wall = torch.full((HEIGHT, WIDTH, 3), 120, dtype=torch.uint8)
    rgb, depth = wall.expand(FRAMES, -1, -1, -1).clone(), torch.full((FRAMES, HEIGHT, WIDTH), FAR)
    instances = torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.uint8)
    for frame in range(FRAMES):
        rgb[frame, *square(frame)] = torch.tensor([200, 40, 40], dtype=torch.uint8)
        depth[frame, *square(frame)], instances[frame, *square(frame)] = NEAR, 1
    none = torch.zeros(0, FRAMES)
    tracks = PointTracks(torch.zeros(0, FRAMES, 2), none.bool(), none, torch.zeros(0, dtype=torch.long))
    static = background_gaussians(wall, torch.full((HEIGHT, WIDTH), FAR), camera, 10_000)
    moving = pixel_gaussians(rgb[0], depth[0], camera, 0)[0].select((instances[0] > 0).reshape(-1))
    rows = torch.zeros(len(moving), 1)
    scene = DynamicScene(static, moving, (identity_level(torch.zeros(1, 3), FRAMES),), (rows.long(),), (rows,), FRAMES)
    return scene, View(rgb, camera), Priors(depth, instances, tracks, DepthTraits(metric=True))


def red(scene: DynamicScene, camera: CameraTrack, frame: int) -> torch.Tensor:
    """Where a picture of the scene is red."""
    rgb = render_scene(scene, camera.select([0]), torch.tensor([frame])).rgb[0]
    return rgb[..., 0] - rgb[..., 1] > 0.3


def test_the_recorded_camera_sees_what_it_recorded(recorded: tuple[DynamicScene, View, Priors]) -> None:
    scene, view, priors = recorded
    mended = dataclasses.replace(scene, overlay=overlay_of(scene, view, priors))
    for frame in range(FRAMES):
        expected = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
        expected[square(frame)] = True
        assert (red(scene, view.camera, frame) ^ expected).sum() > (100 if frame > 0 else -1)
        assert (red(mended, view.camera, frame) ^ expected).sum() <= 4 * SIDE  # pixels along its border


def test_another_camera_sees_it_at_its_depth(recorded: tuple[DynamicScene, View, Priors]) -> None:
    scene, view, priors = recorded
    mended = dataclasses.replace(scene, overlay=overlay_of(scene, view, priors))
    elsewhere = dataclasses.replace(view.camera, world_from_camera=orbit_offset(8.0, 0.0, FAR).expand(FRAMES, 4, 4))
    found = red(mended, elsewhere, 3).nonzero().float().mean(0)
    here = red(mended, view.camera, 3).nonzero().float().mean(0)
    # Before the point at which both look, things move to the left as the camera moves to the right.
    focal = float(view.camera.intrinsics[0, 0, 0])
    x = (here[1] + 0.5 - WIDTH / 2) / focal * NEAR
    turned = torch.tensor(8.0).deg2rad()
    side = x * turned.cos() - (FAR - NEAR) * turned.sin()
    ahead = FAR - x * turned.sin() - (FAR - NEAR) * turned.cos()
    torch.testing.assert_close(found[1] + 0.5, WIDTH / 2 + focal * side / ahead, atol=1.0, rtol=0)


def test_nothing_is_added_where_all_is_explained(recorded: tuple[DynamicScene, View, Priors]) -> None:
    scene, view, priors = recorded
    wall = dataclasses.replace(view, rgb=view.rgb * 0 + 120)
    behind = dataclasses.replace(priors, depth=torch.full_like(priors.depth, FAR))
    without = DynamicScene(scene.static, scene.moving.select(slice(0, 0)), (), (), (), FRAMES)
    overlay = overlay_of(without, wall, behind)
    assert len(overlay.means) == 0
    assert not overlay.hidden.any()


@pytest.mark.parametrize(
    ("traits", "contradicts"), [(DepthTraits(metric=True), True), (DepthTraits(assumed=True), False)]
)
def test_depth_that_is_only_assumed_contradicts_nothing(
    recorded: tuple[DynamicScene, View, Priors], traits: DepthTraits, contradicts: bool
) -> None:
    scene, view, priors = recorded
    wall = dataclasses.replace(view, rgb=view.rgb * 0 + 120)
    nearer = dataclasses.replace(priors, depth=torch.full_like(priors.depth, NEAR), depth_traits=traits)
    without = DynamicScene(scene.static, scene.moving.select(slice(0, 0)), (), (), (), FRAMES)
    assert (len(overlay_of(without, wall, nearer).means) > 0) is contradicts


def test_what_motion_explains_is_left_to_it(recorded: tuple[DynamicScene, View, Priors]) -> None:
    scene, view, priors = recorded
    overlay = overlay_of(scene, view, priors)
    own = len(scene.static) + len(scene.moving)
    right, wrong = (overlay.patch(frame, own) for frame in (0, 3))
    assert len(right) < 0.2 * len(wrong)
    assert right.hidden[len(scene.static) :].float().mean() < 0.5  # the square is where it was believed to be
    assert wrong.hidden[len(scene.static) :].float().mean() > 0.9


def test_the_same_is_unexplained_at_any_size() -> None:
    """A moving square whose left border has another colour: what lies near it is condemned with it."""
    shares = []
    for width in (160, 320, 640):
        height, unit = 3 * width // 4, width // 160
        recorded, rendered = torch.full((height, width, 3), 0.5), torch.full((1, height, width, 3), 0.5)
        rendered[0, 40 * unit : 80 * unit, 40 * unit : 44 * unit] = 0.8  # 4 of 160 px
        rendered[0, 90 * unit : 96 * unit, 10 * unit : 16 * unit] = 0.66  # of what stands still
        moving = torch.zeros(1, height, width)
        moving[0, 40 * unit : 80 * unit, 40 * unit : 120 * unit] = 1
        depth = torch.ones(1, height, width)
        wrong = wrong_pixels(Rendering(rendered, depth, depth, moving), recorded, depth[0].numpy(), 0.02)
        shares.append((float(wrong[40 * unit : 80 * unit].mean()), float(wrong[86 * unit :].mean())))
    for first, second in shares[1:]:
        assert first == pytest.approx(shares[0][0], rel=0.2)  # windows are odd numbers of pixels
        assert second == pytest.approx(shares[0][1], rel=0.3)  # a pixel along its border is added at any size
    assert shares[0][0] * 160 > 2 * 4, "more than the border itself"


def test_what_has_one_colour_keeps_it(recorded: tuple[DynamicScene, View, Priors]) -> None:
    """Where a pixel is half covered, along the picture's border too: brighter ones would be a line from elsewhere."""
    scene, view, priors = recorded
    bright = dataclasses.replace(view, rgb=view.rgb * 0 + 230)
    colours = overlay_of(scene, bright, priors).rgb
    assert len(colours) > FRAMES * WIDTH
    torch.testing.assert_close(colours.float(), torch.full_like(colours, 230 / 255).float(), atol=0.02, rtol=0)


def test_overlays_are_saved(recorded: tuple[DynamicScene, View, Priors], tmp_path: Path) -> None:
    scene, view, priors = recorded
    mended = dataclasses.replace(scene, overlay=overlay_of(scene, view, priors))
    save_scene(mended, tmp_path / "scene.safetensors")
    again, frames = load_scene(tmp_path / "scene.safetensors"), torch.arange(FRAMES)
    assert torch.equal(render_scene(again, view.camera, frames).rgb, render_scene(mended, view.camera, frames).rgb)
