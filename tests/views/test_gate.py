"""The gate: what it expects of a new view, and which ones it keeps, without ground truth."""

import dataclasses

import pytest
import torch

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import GateConfig, Recipe
from lerobot_msdyn.core.observations import DepthTraits, View
from lerobot_msdyn.priors import PointTracks, Priors
from lerobot_msdyn.reconstruction.account import decibels
from lerobot_msdyn.reconstruction.fast_camera import sharpness
from lerobot_msdyn.reconstruction.reconstruct import reconstruct
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.reconstruction.self_check import (
    SelfCheck,
    flicker,
    similarity,
    stands_still,
    unsteadiness,
)
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.views.expected_error import expected_error
from lerobot_msdyn.views.gate import MAX_RATIO, Scores, judge, ratio, reasons, record, sharpness_ratio, video_reasons
from lerobot_msdyn.views.offsets import orbit_offset

FRAMES, WIDTH, HEIGHT = 30, 64, 48
HELD_OUT = [7, 14, 22]  # of so many frames, by the default number


@pytest.fixture(scope="module")
def pushed() -> View:
    scene = make_scene("push", 0, FRAMES, WIDTH, HEIGHT)
    seen = scene.render(scene.camera)
    return View(seen.rgb, scene.camera, seen.depth)


def fitted(view: View, steps: int) -> Reconstruction:
    recipe = Recipe()
    recipe.fit.steps = steps
    return reconstruct(view, recipe)


@pytest.fixture(scope="module")
def scene(pushed: View) -> Reconstruction:
    return fitted(pushed, 40)


def turned(camera: CameraTrack, degrees: float, distance: float) -> CameraTrack:
    offset = orbit_offset(float(degrees), 0.0, distance)
    return dataclasses.replace(camera, world_from_camera=camera.world_from_camera @ offset)


def score(scene: Reconstruction, degrees: float) -> Scores:
    return judge(scene.windows, turned(scene.camera, degrees, scene.distance))


def test_witnesses_are_frames_that_were_not_fitted(scene: Reconstruction) -> None:
    self_check = scene.windows[0].self_check
    assert self_check.held_out
    assert self_check.frames.tolist() == HELD_OUT
    assert len(self_check.frames) == 3
    assert 15 < decibels(float(self_check.fitted_error.mean())) < 50
    assert self_check.error.mean() < self_check.fitted_error.mean(), "new views are drawn with the overlay"
    assert self_check.moving_error > self_check.fitted_error.mean()
    assert self_check.depth_error == pytest.approx(0.01, abs=0.002)
    assert 0 < self_check.track_px < GateConfig().max_track_px


def test_what_moves_is_accounted_for(scene: Reconstruction) -> None:
    check, (window,) = scene.windows[0].self_check, scene.windows
    account = scene.account
    assert account == check.account
    assert account.pixels.total == int(check.moving.sum()) > 100
    assert account.held_out
    assert account.error < account.error_by_motion == check.moving_error
    shares = account.pixels.shares
    assert shares["by_overlay"] + shares["by_short_lived"] > 0.5, "so small a video is hardly explained by motion"
    alone = scene.by_motion_alone()
    assert alone.windows[0].scene.overlay is None
    assert window.scene.overlay is not None
    here, there, without = score(scene, 0), score(scene, 8), score(alone, 8)
    assert here.by_overlay == pytest.approx(shares["by_overlay"], abs=0.1)
    assert here.by_short_lived == pytest.approx(shares["by_short_lived"], abs=0.1)
    assert there.by_motion + there.by_short_lived + there.by_overlay == pytest.approx(1, abs=0.02)
    assert there.by_short_lived + there.by_overlay > 0.5
    assert (without.by_motion, without.by_short_lived, without.by_overlay) == (1, 0, 0)
    assert there.moving_db == pytest.approx(account.dynamic_by_motion_db)
    assert there.moving_with_overlay_db == pytest.approx(account.dynamic_db)


def test_short_videos_have_witnesses_too(pushed: View) -> None:
    assert pushed.depth is not None
    for frames in (1, 2, 7):
        short = View(pushed.rgb[:frames], pushed.camera.select(slice(0, frames)), pushed.depth[:frames])
        scores = score(fitted(short, 2), 5)
        assert not scores.held_out
        assert 1 <= len(scores.frames) <= 3
        assert scores.expected_db > 5


def test_farther_cameras_are_expected_to_be_worse(scene: Reconstruction) -> None:
    found = [score(scene, degrees) for degrees in (0, 5, 15, 30)]
    expected = [scores.expected_db for scores in found]
    assert expected == sorted(expected, reverse=True)
    angles = [scores.angle_deg for scores in found]
    assert angles == sorted(angles)
    assert angles[0] < 0.5
    assert found[0].unseen < found[3].unseen


def test_a_scene_that_was_hardly_fitted_is_expected_to_be_worse(pushed: View, scene: Reconstruction) -> None:
    assert score(fitted(pushed, 1), 5).expected_db < score(scene, 5).expected_db - 0.5


def test_depth_that_disagrees_with_the_scene_is_expected_to_be_worse(scene: Reconstruction) -> None:
    self_check = scene.windows[0].self_check
    new = turned(self_check.camera, 15, scene.distance)
    wrong = dataclasses.replace(self_check, depth=self_check.depth * 1.2)
    assert expected_error(wrong, new).geometry.mean() > 2 * expected_error(self_check, new).geometry.mean()
    rough = dataclasses.replace(self_check, depth_error=0.1)
    assert expected_error(rough, new).depth.mean() > 3 * expected_error(self_check, new).depth.mean()


def test_depth_that_is_not_steady_is_known_to_be_wrong() -> None:
    generator = torch.Generator().manual_seed(0)
    instances = torch.zeros(20, 12, 16, dtype=torch.uint8)
    instances[:, :4] = 1  # what moves has many depths
    depth = torch.full((20, 12, 16), 0.8)
    depth[:, :4] = torch.rand(20, 4, 16, generator=generator) + 0.5
    nothing = torch.zeros(0, 20)
    tracks = PointTracks(torch.zeros(0, 20, 2), nothing.bool(), nothing, torch.zeros(0).long())
    steady = Priors(depth, instances, tracks, DepthTraits(metric=True))
    assert unsteadiness(steady) == pytest.approx(0, abs=1e-6)
    noise = torch.exp(0.03 * torch.randn(20, 1, 1, generator=generator))
    assert unsteadiness(dataclasses.replace(steady, depth=depth * noise)) == pytest.approx(0.03, rel=0.4)
    assert unsteadiness(dataclasses.replace(steady, depth=torch.zeros_like(depth))) == 0


def test_unknown_depth_is_nothing_to_disagree_with(scene: Reconstruction) -> None:
    self_check = scene.windows[0].self_check
    unknown = dataclasses.replace(self_check, depth=torch.zeros_like(self_check.depth))
    found = expected_error(unknown, turned(self_check.camera, 15, scene.distance))
    assert found.geometry.tolist() == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    assert torch.isfinite(found.total).all()


def test_errors_by_cause_add_up(scene: Reconstruction) -> None:
    self_check: SelfCheck = scene.windows[0].self_check
    found = expected_error(self_check, turned(self_check.camera, 8, scene.distance))
    assert sum(found.shares.values()) == pytest.approx(1, abs=1e-5)
    assert found.psnr_db == pytest.approx(decibels(float(found.total.mean())))


def test_what_stands_still_does_not_flicker_more_than_in_the_video(scene: Reconstruction) -> None:
    assert score(scene, 5).flicker_ratio <= 1


def test_ratios_cannot_explode(scene: Reconstruction) -> None:
    assert ratio(0.1, 0.0) == ratio(1e9, 1e-9) == MAX_RATIO
    assert ratio(0.0, 0.0) == 1
    assert ratio(0.02, 0.04) == pytest.approx(0.5)
    assert sharpness_ratio([(0.1, 0.1), (0.1, 1e-9), (0.02, 0.1)]) == pytest.approx(0.6)
    (window,) = scene.windows
    recorded = window.self_check.recorded.clone()
    recorded[0] = 0
    blank = dataclasses.replace(window, self_check=dataclasses.replace(window.self_check, recorded=recorded))
    scores = judge([blank], scene.camera)
    assert scores.sharpness_ratio == pytest.approx(score(scene, 0).sharpness_ratio, rel=0.5)
    assert all(frame.sharpness_ratio <= MAX_RATIO for frame in scores.frames)


def test_measures() -> None:
    pictures = torch.rand(2, 24, 32, 3, generator=torch.Generator().manual_seed(0))
    assert similarity(pictures, pictures) == pytest.approx(1, abs=1e-4)
    assert similarity(pictures, 1 - pictures) < 0.2
    assert sharpness(pictures) > 10 * sharpness(0.1 * pictures)
    for width, side in ((320, 5), (640, 9), (160, 3), (64, 3)):  # the same part of the picture, and a pixel at least
        moving = torch.zeros(1, 20, width, dtype=torch.bool)
        moving[0, 10, 30] = True
        assert stands_still(moving).sum() == 20 * width - side**2
    assert flicker(pictures, pictures + 0.1, torch.ones(2, 24, 32, dtype=torch.bool)) == pytest.approx(0.1)
    assert flicker(pictures, pictures + 0.1, torch.zeros(2, 24, 32, dtype=torch.bool)) == 0
    assert decibels(0.01) == pytest.approx(20)


def test_the_verdict_says_why(scene: Reconstruction) -> None:
    scores = score(scene, 10)
    assert reasons(scores, GateConfig()) == []
    for config, word in (
        (GateConfig(min_expected_db=60.0), "gate.min_expected_db 60"),
        (GateConfig(max_track_px=0.0), "gate.max_track_px 0"),
        (GateConfig(max_flicker_ratio=0.0), "gate.max_flicker_ratio 0"),
        (GateConfig(min_sharpness_ratio=9.0), "gate.min_sharpness_ratio 9"),
    ):
        (reason,) = reasons(scores, config)
        assert word in reason
        assert "\n" not in reason


def test_a_camera_that_goes_too_fast_is_told(scene: Reconstruction) -> None:
    scores = score(scene, 10)
    assert (scores.skew_px, scores.fast_sharpness) == (0, 1), "this camera stands still"
    assert video_reasons(scene.windows, GateConfig()) == []
    (window,) = scene.windows
    fast = dataclasses.replace(window.self_check, skew_px=13.0, fast_sharpness=0.05)
    bent, blurred = video_reasons([dataclasses.replace(window, self_check=fast)], GateConfig())
    assert "by 13.0 px (of 320), over gate.max_skew_px 12" in bent
    assert "0.05 of the sharpness of slow ones, under gate.min_fast_sharpness 0.1" in blurred


def test_the_record_holds_plain_values(scene: Reconstruction) -> None:
    found = record(score(scene, 10))
    assert [frame["frame"] for frame in found["frames"]] == scene.windows[0].self_check.frames.tolist()
    assert len(found["heat"]) == 18
    assert all(0 <= value <= 100 for row in found["heat"] for value in row)
    assert set(found["causes"]) == {"video", "geometry", "depth", "sampling"}
