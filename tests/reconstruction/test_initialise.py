"""From priors to a scene: what moves is gathered from many frames into one canonical frame."""

import dataclasses
import importlib
from pathlib import Path

import pytest
import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.config import MotionConfig, SceneConfig
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, quaternion_to_matrix, se3, unproject
from lerobot_msdyn.core.observations import DepthTraits, View
from lerobot_msdyn.motion.model.bases import identity_level, level_from_motions
from lerobot_msdyn.motion.model.scene_motion import SceneMotion
from lerobot_msdyn.priors import PointTracks, Priors
from lerobot_msdyn.reconstruction.background import pixel_gaussians
from lerobot_msdyn.reconstruction.fit import psnr
from lerobot_msdyn.reconstruction.initialise import contradicted, initialise, merge_voxels, to_canonical
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import gaussians_from_points
from lerobot_msdyn.synthetic import make_scene

pytestmark = pytest.mark.slow

FRAMES, WIDTH, HEIGHT = 16, 80, 60


@pytest.fixture(scope="module")
def pushed() -> tuple[View, Priors]:
    """A pushed block with its true depth, instances and tracks."""
    scene = make_scene("push", 0, FRAMES, WIDTH, HEIGHT)
    seen = scene.render(scene.camera)
    tracks = scene.tracks(600)
    priors = Priors(
        seen.depth,
        seen.instances,
        PointTracks(tracks.xy, tracks.visible, tracks.visible.float(), tracks.instance),
        DepthTraits(metric=True),
    )
    return View(seen.rgb, scene.camera, seen.depth), priors


@pytest.fixture(scope="module")
def initial(pushed: tuple[View, Priors]) -> DynamicScene:
    """Its initial scene with the default numbers of Gaussians."""
    return initialise(*pushed, SceneConfig(), MotionConfig())


def test_the_initial_scene_already_shows_the_video(pushed: tuple[View, Priors], initial: DynamicScene) -> None:
    assert len(initial.moving) > 100
    assert initial.frames == FRAMES
    assert psnr(initial, pushed[0], torch.arange(FRAMES)) > 17


def test_bounds_on_the_number_of_gaussians_hold(pushed: tuple[View, Priors], initial: DynamicScene) -> None:
    few = initialise(*pushed, SceneConfig(static_gaussians=1500, moving_gaussians=100), MotionConfig())
    assert len(few.static) <= 1500
    assert 30 < len(few.moving) <= 100
    assert few.moving.log_scales.mean() > initial.moving.log_scales.mean()


def test_a_bound_below_the_number_of_parts_ends_too(pushed: tuple[View, Priors]) -> None:
    assert 0 < len(initialise(*pushed, SceneConfig(moving_gaussians=1), MotionConfig()).moving) <= 1


@pytest.mark.parametrize("why", ["no tracks", "not wanted"])
def test_a_scene_without_motion(pushed: tuple[View, Priors], why: str) -> None:
    view, priors = pushed
    config = SceneConfig()
    if why == "no tracks":
        unseen = torch.zeros_like(priors.tracks.visible)
        priors = dataclasses.replace(priors, tracks=dataclasses.replace(priors.tracks, visible=unseen))
    else:
        config.moving_gaussians = 0
    scene = initialise(view, priors, config, MotionConfig())
    assert len(scene.moving) == 0
    assert scene.at(torch.tensor([0, FRAMES - 1])).means.shape == (2, len(scene.static), 3)


def test_isotropic_gaussians_are_balls(pushed: tuple[View, Priors]) -> None:
    scene = initialise(*pushed, SceneConfig(isotropic=True), MotionConfig(levels=["object"]))
    assert scene.moving.log_scales.shape == (len(scene.moving), 1)
    assert scene.at(torch.tensor([0])).scales.std(dim=1).max() == 0
    assert psnr(scene, pushed[0], torch.arange(FRAMES)) > 15


@pytest.mark.parametrize("levels", [["object", "primitive"], ["flat"], ["field"]])
def test_every_model_of_motion_shows_the_video(
    pushed: tuple[View, Priors], levels: list, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    importlib.import_module("rivals").register()
    scene = initialise(*pushed, SceneConfig(), MotionConfig(levels=levels, gate=False))
    assert len(scene.levels) == len(levels)
    assert psnr(scene, pushed[0], torch.arange(FRAMES)) > 16


def test_carried_back_by_the_motion_of_their_part() -> None:
    motions = torch.eye(4).repeat(2, 2, 1, 1)
    motions[1, 1] = se3(axis_angle_to_matrix(torch.tensor([0.0, 0.0, torch.pi / 2])), torch.tensor([1.0, 0.0, 0.0]))
    level = level_from_motions(motions, torch.zeros(2, 3))
    tracked = torch.tensor([[0.5, 0.0, 1.0], [0.5, 0.0, 1.0]])
    motion = SceneMotion(("object",), (level,), 0, tracked, torch.tensor([0, 1]), torch.tensor([1, 2]))
    points = torch.tensor([[0.5, 0.0, 1.0], [1.0, 0.5, 1.0]])
    seen = gaussians_from_points(points, torch.tensor([[1.0, 0, 0, 0]] * 2), torch.ones(2, 3), torch.ones(2, 3), 0.9)
    back, part = to_canonical(seen, motion, 1, torch.tensor([1, 2]))
    assert part.tolist() == [0, 1]
    # The second was at (0.5, 0, 1): a quarter turn makes it (0, 0.5, 1), the shift (1, 0.5, 1).
    torch.testing.assert_close(back.means, torch.tensor([[0.5, 0.0, 1.0], [0.5, 0.0, 1.0]]), atol=1e-6, rtol=0)
    turned = quaternion_to_matrix(back.quats[1])
    torch.testing.assert_close(turned, motions[1, 1, :3, :3].T, atol=1e-6, rtol=0)


def test_points_in_one_voxel_and_part_become_one() -> None:
    points = torch.tensor([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [0.2, 0.1, 0.1], [0.9, 0.1, 1.1]])
    colours = torch.tensor([[0.2, 0.5, 0.5], [0.4, 0.5, 0.5], [0.9, 0.5, 0.5], [0.6, 0.5, 0.5]])
    gaussians = gaussians_from_points(points, torch.ones(4, 4), torch.ones(4, 3), colours, 0.9)
    merged, part = merge_voxels(gaussians, torch.tensor([0, 0, 1, 0]), 1.0)
    order = merged.means[:, 0].argsort()
    torch.testing.assert_close(merged.means[order, 0], torch.tensor([0.2, 0.2, 0.9]))
    assert sorted(part.tolist()) == [0, 0, 1]
    assert sorted(round(float(value), 4) for value in merged.rgb[:, 0]) == [0.3, 0.6, 0.9]


def test_moving_gaussians_lie_on_the_recorded_surface(pushed: tuple[View, Priors], initial: DynamicScene) -> None:
    view, priors = pushed
    frame = 5
    surface, _ = pixel_gaussians(view.rgb[frame], priors.depth[frame], view.camera, frame)
    moving = initial.at(torch.tensor([frame])).means[0, len(initial.static) :]
    inside = (priors.instances[frame] > 0).reshape(-1)
    distance = torch.cdist(surface.means[inside], moving).min(dim=1).values
    pixel = priors.depth[frame].reshape(-1)[inside].median() / view.camera.intrinsics[0, 0, 0]
    assert float(distance.median()) < float(pixel)


def test_points_in_front_of_what_stands_still_are_contradicted() -> None:
    camera = static_camera(intrinsics_from_fov(40, 30, 60.0), 4, 40, 30)
    depth = torch.ones(4, 30, 40)
    instances = torch.zeros(4, 30, 40, dtype=torch.uint8)
    instances[:, 10:20, 10:20] = 1
    view = View(torch.zeros(4, 30, 40, 3, dtype=torch.uint8), camera)
    nothing = PointTracks(
        torch.zeros(0, 4, 2), torch.zeros(0, 4, dtype=torch.bool), torch.zeros(0, 4), torch.zeros(0, dtype=torch.long)
    )
    priors = Priors(depth, instances, nothing, DepthTraits(metric=True))
    xy = torch.tensor([[15.0, 15.0], [30.0, 15.0], [30.0, 15.0], [-9.0, 15.0]])
    z = torch.tensor([0.9, 0.9, 1.1, 0.9])  # on the mask; in front of the wall; behind it; outside the image
    points = unproject(xy, z, camera.intrinsics[0])
    nobody = torch.zeros(0, dtype=torch.long)
    still = SceneMotion(("object",), (identity_level(torch.zeros(1, 3), 4),), 0, torch.zeros(0, 3), nobody, nobody)
    found = contradicted(points, torch.zeros(4, dtype=torch.long), still, view, priors, [0, 1, 2, 3])
    assert found.tolist() == [False, True, False, False]
