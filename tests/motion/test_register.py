"""Rigid parts registered to what was recorded: errors fall, the canonical frame stays, the unknown changes nothing."""

from dataclasses import replace

import pytest
import torch
from motion_levels import of_bases

from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.geometry import invert_se3
from lerobot_msdyn.motion.model.bases import level_affines, level_from_motions
from lerobot_msdyn.motion.model.scene_motion import SceneMotion
from lerobot_msdyn.motion.to_video.alignment import Sightings, Video
from lerobot_msdyn.motion.to_video.register import Recording
from lerobot_msdyn.motion.to_video.regroup import Grouping
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


@pytest.fixture(scope="module")
def recording(scene: SyntheticScene, view: SyntheticView) -> Recording:
    found = Recording.of(view.rgb, view.depth, view.instances, scene.camera)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def registered(recording: Recording, disturbed: SceneMotion) -> SceneMotion:
    return recording.register(disturbed, MotionConfig())


def test_registration_corrects_disturbed_poses(
    tracks: SyntheticTracks, disturbed: SceneMotion, registered: SceneMotion
) -> None:
    before, after = errors_mm(disturbed, tracks), errors_mm(registered, tracks)
    assert after.mean() < 0.6 * before.mean()
    assert after.median() < 0.4 * before.median()


def test_canonical_frame_stays_the_identity(registered: SceneMotion) -> None:
    at_canonical = level_affines(of_bases(registered.levels)[0], torch.tensor([CANONICAL]))[:, 0]
    torch.testing.assert_close(at_canonical, torch.eye(3, 4).expand_as(at_canonical), atol=1e-5, rtol=0)


def test_judges_prefer_the_better_motion(recording: Recording, disturbed: SceneMotion, registered: SceneMotion) -> None:
    assert recording.costs(registered)[0].mean() < 0.9 * recording.costs(disturbed)[0].mean()


def test_a_worse_motion_is_refused(
    recording: Recording, registered: SceneMotion, monkeypatch: pytest.MonkeyPatch
) -> None:
    def shifted(video: Video, points: Sightings, start: Grouping, max_parts: int, known: int) -> Grouping:
        off = torch.eye(4).repeat(FRAMES, 1, 1).double()
        off[::2, 2, 3] = 0.05
        return replace(start, motions=off @ start.motions)

    monkeypatch.setattr("lerobot_msdyn.motion.to_video.register.regroup", shifted)
    assert recording.register(registered, MotionConfig()) is registered


def test_a_level_that_disagrees_with_the_video_is_not_approved(recording: Recording, registered: SceneMotion) -> None:
    (level,) = of_bases(registered.levels)
    count = len(level)
    motions = torch.eye(4).repeat(count, FRAMES, 1, 1)
    approve = recording.approval(registered, "primitive")
    parents, pivots = torch.arange(count), level.pivots
    still = level_from_motions(motions, pivots, parents=parents, canonical=CANONICAL)
    motions[:, 1::2, 2, 3] = 0.03
    shaken = level_from_motions(motions, pivots, parents=parents, canonical=CANONICAL)
    followed = registered.part.unique()
    assert not bool(approve(still)[followed].any())
    assert not bool(approve(shaken)[followed].any())


def test_inactive_parts_stay(recording: Recording, disturbed: SceneMotion) -> None:
    (level,) = of_bases(disturbed.levels)
    still = replace(level, active=torch.zeros_like(level.active))
    found = recording.register(replace(disturbed, levels=(still,)), MotionConfig())
    assert not bool(of_bases(found.levels)[0].active.any())


def test_without_depth_there_is_no_recording(scene: SyntheticScene, view: SyntheticView) -> None:
    assert Recording.of(view.rgb, torch.zeros_like(view.depth), view.instances, scene.camera) is None


def test_depth_of_few_pixels_changes_nothing(
    scene: SyntheticScene, view: SyntheticView, disturbed: SceneMotion
) -> None:
    sparse = torch.zeros_like(view.depth)
    sparse[:, ::8, ::8] = view.depth[:, ::8, ::8]  # no normals
    recording = Recording.of(view.rgb, sparse, view.instances, scene.camera)
    assert recording is not None
    assert recording.register(disturbed, MotionConfig()) is disturbed
