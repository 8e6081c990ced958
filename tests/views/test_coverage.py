"""What of a new view is uncovered: against synthetic scenes whose every surface is known."""

from dataclasses import replace

import pytest
import torch

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov, static_camera
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.geometry import se3, transform_points, unproject_image
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.reconstruction.background import EmptyScene, background_gaussians
from lerobot_msdyn.reconstruction.evidence import Evidence, evidence_of, still_frames
from lerobot_msdyn.reconstruction.key_views import fixed_view
from lerobot_msdyn.reconstruction.reconstruct import reconstruct
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.rendering import Rendering, render_scene
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.nvs import covisibility
from lerobot_msdyn.synthetic.viewpoints import heldout_cameras
from lerobot_msdyn.views.coverage import Coverage, angles_of, coverage_of, looked
from lerobot_msdyn.views.pictures import coverages, new_pictures

WIDTH, HEIGHT = SIZE = 64, 48
STEP = WIDTH // 2  # first column of the nearer half of the wall


def wall() -> tuple[DynamicScene, Evidence, CameraTrack]:
    """A wall at 1 m, its right half nearer, at 0.5 m; a patch of it was never seen."""
    camera = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), 3, WIDTH, HEIGHT)
    depth = torch.full((HEIGHT, WIDTH), 1.0)
    depth[:, STEP:] = 0.5
    seen = torch.full((HEIGHT, WIDTH), 3)
    seen[10:20, 8:16] = 0
    empty = EmptyScene(torch.full((HEIGHT, WIDTH, 3), 128, dtype=torch.uint8), depth, seen)
    static = background_gaussians(empty.rgb, depth, camera, 100_000)
    scene = DynamicScene(static, static.select(slice(0)), (), (), (), 3)
    return scene, evidence_of(scene, camera, fixed_view(empty, camera)), camera


def covered(offset: torch.Tensor) -> Coverage:
    scene, evidence, camera = wall()
    times = torch.tensor([1])
    moved = CameraTrack(camera.intrinsics[:1], offset[None], WIDTH, HEIGHT)
    rendering = render_scene(scene, moved, times, extra=evidence.moving_frames)
    return coverage_of(rendering, moved, evidence)[0]


def shifted(x: float, z: float = 0.0) -> torch.Tensor:
    return se3(torch.eye(3), torch.tensor([x, 0.0, z]))


def test_from_the_recorded_camera_only_what_was_hidden_is_unseen() -> None:
    found = covered(shifted(0.0))
    assert found.unseen[11:19, 9:15].all()
    assert found.unseen_share == pytest.approx(80 / (WIDTH * HEIGHT), abs=0.02)
    assert set(found.frames_seen[~found.unseen]) == {3}
    assert not found.empty.any()


def test_beyond_the_border_and_behind_an_edge_nothing_was_seen() -> None:
    left = covered(shifted(-0.1))
    focal = WIDTH / 2 / 0.57735
    assert left.empty[:, : int(0.1 * focal) - 1].all(), "beyond the left border"
    edge = STEP + 0.1 * focal / 0.5  # of the nearer half, in the new view
    hidden = slice(round(STEP + 0.1 * focal) + 1, int(edge) - 1)  # between where the far half ends and that
    assert left.unseen[:, hidden].mean() > 0.9
    assert not left.unseen[25:, 12:28].any(), "the far half, as it was seen"
    assert left.frames_seen[left.unseen].max() == 0


def test_angle_is_that_between_the_lines_of_sight() -> None:
    camera = wall()[2]
    depth = torch.full((HEIGHT, WIDTH), 1.0)
    moved = CameraTrack(camera.intrinsics[:1], shifted(0.1)[None], WIDTH, HEIGHT)
    row, column = HEIGHT // 2 + 4, 10
    assert angles_of(depth, moved, camera)[row, column] == pytest.approx(5.2, abs=0.8)  # of 0.1 m at 1.07 m
    assert angles_of(depth, camera, camera).max() < 0.1


def test_what_the_frame_before_has_shown_holds() -> None:
    scene, evidence, camera = wall()
    poses = camera.select([0, 0, 0])
    rendering = render_scene(scene, poses, torch.tensor([0, 1, 2]), extra=evidence.moving_frames)
    changed = rendering.depth.clone()
    changed[1, 10:20, 12:22] *= 1.1  # for a frame what is behind shows
    together = coverage_of(replace(rendering, depth=changed), poses, evidence)
    for i, found in enumerate(together):
        alone = Rendering(*(getattr(rendering, name)[[i]] for name in ("rgb", "depth", "alpha", "moving", "extra")))
        expected = coverage_of(replace(alone, depth=changed[[i]]), poses.select([i]), evidence)[0]
        assert (found.frames_seen == expected.frames_seen).all()
    assert together[1].unseen.sum() > together[0].unseen.sum() == together[2].unseen.sum()


@pytest.mark.parametrize("kind", ["push", "sheet"])
def test_agrees_with_the_true_covisibility(kind: str) -> None:
    frames, shown = 12, [2, 8]
    scene = make_scene(kind, 0, frames, WIDTH, HEIGHT)
    seen = scene.render(scene.camera)
    settings = Recipe()
    settings.fit.steps = 10
    found = reconstruct(View(seen.rgb, scene.camera, seen.depth), settings)
    assert seen.depth is not None
    errors = []
    for camera in heldout_cameras(len(shown), WIDTH, HEIGHT).values():
        true = covisibility(scene, seen.depth.numpy(), camera, shown) == 0
        for coverage, hidden in zip(coverages(found, camera, torch.tensor(shown)), true, strict=True):
            errors.append(abs(coverage.unseen_share - hidden.mean()))
    assert sum(errors) / len(errors) < 0.03


def test_pictures_say_what_was_not_seen() -> None:
    scene = make_scene("push", 0, 6, WIDTH, HEIGHT)
    seen = scene.render(scene.camera)
    settings = Recipe()
    settings.fit.steps = 2
    found = reconstruct(View(seen.rgb, scene.camera, seen.depth), settings)
    moved = CameraTrack(scene.camera.intrinsics, scene.camera.world_from_camera @ shifted(0.1), WIDTH, HEIGHT)
    for picture, coverage in zip(new_pictures(found, moved), coverages(found, moved), strict=True):
        assert (picture.unseen == coverage.unseen).all()
        assert 0.02 < coverage.unseen_share < 0.5
        seen_frames = coverage.frames_seen[~coverage.unseen]
        assert seen_frames.min() >= 1
        assert seen_frames.max() <= 6


def test_the_compiled_look_up_is_that_of_devices() -> None:
    torch.manual_seed(0)
    K, identity = intrinsics_from_fov(WIDTH, HEIGHT, 60.0), torch.eye(4)
    turned = torch.tensor([[0.98, 0.0, 0.199], [0.0, 1.0, 0.0], [-0.199, 0.0, 0.98]])
    keys = CameraTrack(K.expand(2, 3, 3), torch.stack((identity, se3(turned, torch.tensor([0.2, 0.0, 0.1])))), *SIZE)
    depth, frames = 1 + 0.3 * torch.rand(2, HEIGHT, WIDTH), torch.randint(0, 100, (2, HEIGHT, WIDTH))
    evidence = Evidence(keys, keys, depth, frames, torch.zeros(0))
    pose = CameraTrack(
        intrinsics_from_fov(2 * WIDTH, 2 * HEIGHT, 60.0)[None], shifted(0.1)[None], 2 * WIDTH, 2 * HEIGHT
    )
    first = 1 + 0.3 * torch.rand(2 * HEIGHT, 2 * WIDTH)
    second = first.clone()
    second[20:40, 30:60] -= 0.2
    before = looked(first, pose, evidence)
    for picture, found in ((first, before), (second, looked(second, pose, evidence, before))):
        points = transform_points(
            pose.world_from_camera[0], unproject_image(picture, pose.intrinsics[0]).reshape(-1, 3)
        )
        wanted = still_frames(evidence, points).reshape(picture.shape)
        assert (found.still != wanted).float().mean() < 1e-3  # where rounding decides
        assert 0.01 < (wanted == 0).float().mean() < 0.9
    assert (before.still == looked(second, pose, evidence, before).still)[60:].all()
