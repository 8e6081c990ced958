"""Episodes that cover a dataset: far from each other, of every task, the same ones each time."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import made_up_views
import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.augment import run as episodes_of
from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.dataset.cover import covering_episodes, farthest, shared_out
from lerobot_msdyn.dataset.read import open_source
from lerobot_msdyn.dataset.rows import read_columns, read_rows, values_of

FEATURES: dict[str, dict[str, Any]] = {
    key: {"dtype": "float32", "shape": (2,), "names": ["x", "y"]} for key in ("observation.state", "action")
}


def recorded(root: Path, starts: Sequence[tuple[float, float]], tasks: Sequence[str]) -> Path:
    """A dataset without cameras whose episodes begin at `starts` and go on alike."""
    dataset = LeRobotDataset.create("local/points", 10, FEATURES, root=root, use_videos=False)
    for start, task in zip(starts, tasks, strict=True):
        for t in range(4):
            at = np.array(start, np.float32) + t
            dataset.add_frame({"observation.state": at, "action": at, "task": task})
        dataset.save_episode()
    dataset.finalize()
    return root


def test_the_nearest_to_the_mean_and_then_the_farthest() -> None:
    points = np.array([[0.0], [1.0], [5.0], [9.0], [10.0]])
    assert farthest(points, 3) == [2, 0, 4]
    assert farthest(points, 5) == [2, 0, 4, 1, 3]
    assert sorted(farthest(np.zeros((3, 2)), 3)) == [0, 1, 2]


@pytest.mark.parametrize(
    ("count", "sizes", "expected"),
    [
        (3, [10, 10, 10], [1, 1, 1]),
        (4, [2, 20], [1, 3]),
        (5, [1, 10], [1, 4]),
        (1, [3, 9], [1, 0]),
        (3, [1, 2], [1, 2]),
    ],
)
def test_every_task_has_its_share(count: int, sizes: list[int], expected: list[int]) -> None:
    assert shared_out(count, sizes) == expected


def test_alike_episodes_are_not_chosen_twice(tmp_path: Path) -> None:
    starts = [(0, 0), (0.1, 0), (5, 5), (5, 5.1), (9, 0), (9, 0.1)]
    source = open_source("local/points", recorded(tmp_path / "points", starts, ["pick"] * 6))
    chosen = covering_episodes(source, range(6), 0.5)
    assert [index // 2 for index in chosen] == [0, 1, 2]
    assert chosen == covering_episodes(source, range(6), 0.5)
    assert covering_episodes(source, [2, 3], 0.01) in ([2], [3])
    assert covering_episodes(source, range(6), 1) == list(range(6))


def test_a_rare_task_is_not_left_out(tmp_path: Path) -> None:
    starts = [(float(i), 0.0) for i in range(6)]
    source = open_source("local/points", recorded(tmp_path / "points", starts, ["pick"] * 5 + ["push"]))
    assert covering_episodes(source, range(6), 0.34) == [2, 5]


def test_a_value_that_hardly_varies_does_not_tell(tmp_path: Path) -> None:
    """The second of the state's values differs by noise between episodes, and by much within each."""
    starts = [(0.0, 0.02), (10.0, 0.0), (20.0, 0.01), (20.0, -0.02)]
    source = open_source("local/points", recorded(tmp_path / "points", starts, ["pick"] * 4))
    assert 0 in covering_episodes(source, range(4), 0.5)


def test_what_cannot_be_read_is_not_chosen(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_source("local/desk", desk)
    episodes = list(source.episodes)
    episodes[1] = episodes[1] | {"length": 7}
    monkeypatch.setattr(source, "episodes", episodes)
    assert covering_episodes(source, range(3), 1) == [0, 2]
    with pytest.raises(EpisodeError, match=r"local/desk episode 1: .* has 12 rows; expected 7"):
        covering_episodes(source, [1], 0.5)


def test_columns_are_those_of_the_rows(desk: Path) -> None:
    source = open_source("local/desk", desk)
    columns = read_columns(source, 1, ["observation.state", "action"])
    rows = read_rows(source, 1)
    for key, values in columns.items():
        assert np.array_equal(values, values_of(rows, key, source.features[key]))


@pytest.mark.parametrize("include_source", [True, False])
def test_some_episodes_get_new_ones(
    desk: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    include_source: bool,
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(episodes_of, "augment_episode", made_up_views.made_up)
    out = tmp_path / "new"
    command = ["--repo=local/desk", f"--root={desk}", f"--new_root={out}", "--cameras=front", "--variants=2"]
    command += ["--gate.enabled=false", "--scene.shared_background=false", f"--include_source={include_source}"]
    command += ["--episodes_share=0.67", "--workers=1"]
    assert augment.run(command) == 0
    chosen = covering_episodes(open_source("local/desk", desk), range(3), 0.67)
    assert len(chosen) == 2
    rows = pq.read_table(out / "meta" / "msdyn" / "episodes.parquet").to_pylist()
    written = [(row["source_episode"], row["variant"]) for row in rows]
    if include_source:
        assert written == [(e, v) for e in range(3) for v in (-1, 0, 1) if v < 0 or e in chosen]
    else:
        assert [(e, max(v, 0)) for e, v in written if v >= 0] == [(e, v) for e in chosen for v in (0, 1)]
        assert {e for e, _ in written} == set(chosen)
    assert "4 new ones (2 for each of 2 episodes, " in capsys.readouterr().out
    said = [message for message in caplog.messages if "--episodes_share" in message]
    assert len(said) == 1
    assert said[0].startswith("new episodes of 2, chosen to cover what was recorded (--episodes_share): ")
    assert augment.run(command) == 0
    assert capsys.readouterr().out.startswith("finished before: ")
