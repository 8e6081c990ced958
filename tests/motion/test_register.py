"""Rigid parts registered to what was recorded: errors fall, the canonical frame stays, the unknown changes nothing."""

from dataclasses import replace

import pytest
import torch

from lerobot_msdyn.geometry import invert_se3
from lerobot_msdyn.motion.bases import level_affines, level_from_motions
from lerobot_msdyn.motion.follow import SceneMotion
from lerobot_msdyn.motion.register import register_parts
from lerobot_msdyn.synthetic import SyntheticScene, SyntheticTracks, SyntheticView, make_scene

FRAMES, CANONICAL = 12, 6


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return make_scene("push", 0, FRAMES, 160, 120)


@pytest.fixture(scope="module")
def view(scene: SyntheticScene) -> SyntheticView:
    return scene.render(scene.camera)


@pytest.fixture(scope="module")
def tracks(scene: SyntheticScene) -> SyntheticTracks:
    return scene.tracks(400)


@pytest.fixture(scope="module")
def disturbed(scene: SyntheticScene, tracks: SyntheticTracks) -> SceneMotion:
    """The true motion, but each part is some 5 mm off along each axis at every frame but the canonical one."""
    bodies, part = tracks.body.unique(return_inverse=True)
    motions = scene.world_from_body[bodies]
    motions = motions @ invert_se3(motions[:, CANONICAL])[:, None]
    off = 0.005 * torch.randn(len(bodies), FRAMES, 3, generator=torch.Generator().manual_seed(0))
    off[:, CANONICAL] = 0
    motions[..., :3, 3] += off
    points = tracks.positions[:, CANONICAL]
    pivots = torch.stack([points[part == k].mean(0) for k in range(len(bodies))])
    level = level_from_motions(motions, pivots, canonical=CANONICAL)
    return SceneMotion(("object",), (level,), CANONICAL, points, part, tracks.instance)


def errors_mm(motion: SceneMotion, tracks: SyntheticTracks) -> torch.Tensor:
    """Mean error of points predicted from the frames in which they were picked [n]."""
    out = []
    for i, frame in enumerate(tracks.query.tolist()):
        point, part = motion.to_canonical(tracks.positions[i, frame][None], frame, tracks.instance[i : i + 1])
        moved = motion.moved(point, part, torch.arange(FRAMES))[0][:, 0]
        out.append(1000 * (moved - tracks.positions[i]).norm(dim=-1).mean())
    return torch.stack(out)


def test_registration_corrects_disturbed_poses(
    scene: SyntheticScene, view: SyntheticView, tracks: SyntheticTracks, disturbed: SceneMotion
) -> None:
    registered = register_parts(disturbed, view.rgb, view.depth, view.instances, scene.camera)
    before, after = errors_mm(disturbed, tracks), errors_mm(registered, tracks)
    assert after.mean() < 0.6 * before.mean()
    assert after.median() < 0.4 * before.median()


def test_canonical_frame_stays_the_identity(scene: SyntheticScene, view: SyntheticView, disturbed: SceneMotion) -> None:
    registered = register_parts(disturbed, view.rgb, view.depth, view.instances, scene.camera)
    at_canonical = level_affines(registered.levels[0], torch.tensor([CANONICAL]))[:, 0]
    torch.testing.assert_close(at_canonical, torch.eye(3, 4).expand_as(at_canonical), atol=1e-5, rtol=0)


def test_inactive_parts_stay(scene: SyntheticScene, view: SyntheticView, disturbed: SceneMotion) -> None:
    still = replace(disturbed.levels[0], active=torch.zeros_like(disturbed.levels[0].active))
    motion = replace(disturbed, levels=(still,))
    registered = register_parts(motion, view.rgb, view.depth, view.instances, scene.camera)
    torch.testing.assert_close(registered.points, motion.points)
    torch.testing.assert_close(registered.levels[0].pivots, still.pivots)


def test_without_depth_nothing_changes(scene: SyntheticScene, view: SyntheticView, disturbed: SceneMotion) -> None:
    unknown = torch.zeros_like(view.depth)
    assert register_parts(disturbed, view.rgb, unknown, view.instances, scene.camera) is disturbed


def test_depth_of_few_pixels_changes_nothing(
    scene: SyntheticScene, view: SyntheticView, disturbed: SceneMotion
) -> None:
    sparse = torch.zeros_like(view.depth)
    sparse[:, ::8, ::8] = view.depth[:, ::8, ::8]  # no normals
    registered = register_parts(disturbed, view.rgb, sparse, view.instances, scene.camera)
    torch.testing.assert_close(registered.points, disturbed.points)
    torch.testing.assert_close(registered.levels[0].displacements, disturbed.levels[0].displacements)
