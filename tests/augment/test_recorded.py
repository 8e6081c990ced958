"""Recorded pictures that show nothing: named, and not fitted."""

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from augment_command import FAST, FRONT, run
from barcodes import code_of, record
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.augment import recorded
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.dataset.read import open_source, read_episode


def test_blank_frames_are_named_and_rows_stay_in_step(
    desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def spoiled(*arguments: Any, **options: Any) -> Any:
        episode = read_episode(*arguments, **options)
        episode.views[FRONT].rgb[[5, 6, 9]] = 0
        return episode

    monkeypatch.setattr(recorded, "read_episode", spoiled)
    arguments = ["--repo", "local/desk", "--root", str(desk), "--new_root", str(tmp_path / "new"), "--episodes", "[1]"]
    assert run(*arguments, "--cameras", "[front]", "--variants", "1", *FAST) == 0
    assert f"local/desk episode 1, {FRONT}: blank: frames 5 to 6, 9 (not fitted" in capsys.readouterr().err
    assert f"episode 1, {FRONT}: blank: frames 5 to 6, 9" in (tmp_path / "new" / "report.html").read_text()
    row = pq.read_table(tmp_path / "new" / "meta" / "msdyn" / "episodes.parquet").to_pylist()[1]
    (line,) = json.loads(row["gate"])["views"][FRONT]["defects"]
    assert line.startswith("blank: frames 5 to 6, 9")
    new = LeRobotDataset("local/new", root=tmp_path / "new", video_backend="pyav")
    assert len(new) == 24
    assert min(float(new[12 + i][FRONT].mean()) for i in range(12)) > 0.1


def test_an_episode_that_is_mostly_blank_is_refused(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def spoiled(*arguments: Any, **options: Any) -> Any:
        episode = read_episode(*arguments, **options)
        episode.views[FRONT].rgb[4:] = 0
        return episode

    monkeypatch.setattr(recorded, "read_episode", spoiled)
    with pytest.raises(EpisodeError, match=r"episode 0, .*front: 8 of 12 frames are blank"):
        recorded.read_recorded(open_source("local/desk", desk), 0, [FRONT], Recipe())


def test_the_picture_before_an_episode_is_the_last_of_the_one_before(tmp_path: Path) -> None:
    (first, _) = record(tmp_path / "bars", [6, 8])
    source = open_source("local/bars", tmp_path / "bars")
    last = recorded.last_picture(source, 0, FRONT)
    assert last is not None
    assert code_of(last[0]) == first[-1]
    assert recorded.last_picture(source, -1, FRONT) is None
