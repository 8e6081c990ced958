"""The time of a run, from the speeds of its parts."""

from pathlib import Path
from typing import Any

import pytest

from lerobot_msdyn.augment import cost
from lerobot_msdyn.augment.cost import (
    Speeds,
    first_speeds,
    measure_speeds,
    predicted_bytes,
    predicted_output_bytes,
    predicted_scene_bytes,
    predicted_seconds,
)
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.dataset.read import open_source


def test_every_part_is_timed(desk: Path) -> None:
    source = open_source("local/desk", desk)
    speeds = measure_speeds(source, 0, ["observation.images.front"], Recipe())
    assert 0 < speeds.read_s < 1
    assert 0 < speeds.prepare_s < 5
    assert 0 < speeds.step_s < 1
    assert 0 < speeds.render_s < 5
    assert 3_000 * 56 < speeds.scene_bytes < 1e6  # about one Gaussian of 56 bytes per pixel of 64x48, and moving ones
    assert 0 < speeds.frame_bytes < 64 * 48 * 40


def test_an_episode_that_cannot_be_read_does_not_stop_the_estimate(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_source("local/desk", desk)

    def measured(source: Any, index: int, *rest: Any) -> Speeds:
        if index < 2:
            raise EpisodeError(f"episode {index} cannot be read")
        return Speeds(1.0, 2.0, 3.0, 4.0)

    monkeypatch.setattr(cost, "measure_speeds", measured)
    assert first_speeds(source, [0, 1, 2], [], Recipe()) == Speeds(1.0, 2.0, 3.0, 4.0)
    with pytest.raises(EpisodeError, match="episode 0 cannot be read"):
        first_speeds(source, [0, 1], [], Recipe())


def test_parts_are_added_up(desk: Path) -> None:
    source = open_source("local/desk", desk)  # three episodes of twelve frames
    recipe = Recipe(variants=2)
    recipe.fit.steps, recipe.fit.window_frames, recipe.scene.shared_background = 100, 6, False
    speeds = Speeds(read_s=1.0, prepare_s=2.0, step_s=3.0, render_s=4.0)
    assert predicted_seconds(speeds, source, [0, 2], recipe) == pytest.approx(2 * (12 * (1 + 2 + 2 * 4) + 2 * 100 * 3))
    recipe.scene.shared_background = True
    shared = 2 * 3 * 12 * 1 + 12 * 0.3 * 2 + 50 * 3 + 2 * (12 * (1 + 2 + 2 * 4) + 2 * 60 * 3)
    assert predicted_seconds(speeds, source, [0, 2], recipe) == pytest.approx(shared)
    two = predicted_seconds(speeds, source, [0, 2], recipe, workers=2)  # an episode each, and the masks of one
    assert two == pytest.approx(
        (1 + 0.5) * 3 * 12 * 1 + 0.5 * 12 * 0.3 * 2 + 50 * 3 + 12 * (1 + 2 + 2 * 4) + 2 * 60 * 3
    )


def test_disk_is_that_of_the_new_videos(desk: Path) -> None:
    """Recorded episodes keep their size; what is rendered has that of a few frames that were encoded."""
    source, recipe = open_source("local/desk", desk), Recipe(variants=2)
    front = "observation.images.front"
    bytes_of_front = sum(path.stat().st_size for path in (desk / "videos" / front).rglob("*.mp4"))
    speeds = Speeds(1.0, 2.0, 3.0, 4.0, video_bytes=5000.0, videos=(front,))
    assert bytes_of_front > 0
    expected = predicted_output_bytes(source, [0, 1, 2], [0, 1, 2], recipe) - 2 * bytes_of_front + 2 * 36 * 5000
    reports = predicted_bytes(speeds, source, [0, 1, 2], [0, 1, 2], recipe) - expected
    assert reports == pytest.approx(6 * cost.REPORT_BYTES)
    fewer = predicted_bytes(speeds, source, [0, 1, 2], [1], recipe) - 2 * (12 * 5000 + cost.REPORT_BYTES)
    assert fewer == pytest.approx(
        predicted_output_bytes(source, [0, 1, 2], [], recipe)
        + predicted_output_bytes(source, [], [1], recipe)
        - 2 * bytes_of_front / 3
    )


def test_saved_scenes_need_disk(desk: Path) -> None:
    source, recipe = open_source("local/desk", desk), Recipe()
    recipe.fit.window_frames = 6
    speeds = Speeds(1.0, 2.0, 3.0, 4.0, scene_bytes=1000.0, frame_bytes=10.0)
    assert predicted_scene_bytes(speeds, source, [0, 2], recipe) == 2 * 2 * 1000 + 2 * 12 * 10
