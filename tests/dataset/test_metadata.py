"""What is told without LeRobot is what LeRobot tells."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.dataset.metadata import described
from lerobot_msdyn.dataset.read import open_source
from lerobot_msdyn.dataset.select import colour_cameras, select_episodes

DEPTH = "observation.images.front_depth"


@pytest.fixture
def copied(desk: Path, tmp_path: Path) -> Path:
    """A dataset to be changed."""
    return Path(shutil.copytree(desk, tmp_path / "copied"))


def write_info(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change meta/info.json in place."""
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def marked_as_of_old(info: dict[str, Any]) -> None:
    feature = info["features"][DEPTH]
    marked = feature.pop("info")
    marked["video.is_depth_map"] = marked.pop("is_depth_map")
    feature["video_info"] = marked


@pytest.mark.parametrize(
    "change",
    [
        lambda info: None,
        lambda info: info.update(robot_type="so101_follower"),
        marked_as_of_old,
        lambda info: info.update(total_episodes=9, total_frames=108),  # its recorder was killed
    ],
    ids=["whole", "robot", "older mark of depth", "killed"],
)
def test_it_says_what_lerobot_says(copied: Path, change: Callable[[dict[str, Any]], object]) -> None:
    write_info(copied, change)
    early, late = described("local/copied", copied), open_source("local/copied", copied)
    assert early is not None
    for name in ("repo_id", "root", "total_episodes", "camera_keys", "robot_type"):
        assert getattr(early, name) == getattr(late, name)
    assert DEPTH in early.depth_keys
    assert colour_cameras(early) == colour_cameras(late) == ["observation.images.front", "observation.images.side"]
    for index in (5, 999):
        said = []
        for meta in (early, late):
            with pytest.raises(DatasetError) as error:
                select_episodes(meta, [index])
            said.append(str(error.value))
        assert said[0] == said[1]


def test_a_dataset_in_lerobots_home_is_found_and_one_on_the_hub_is_left_to_lerobot(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_LEROBOT_HOME", str(copied.parent))
    there = described("copied")
    assert there is not None
    assert there.root == copied
    assert described("local/elsewhere") is None


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"\xff",
        b"[" * 100_000,
        b"{}",
        b'{"codebase_version": 3}',
        b'{"codebase_version": "v3.0"}',
        b'{"codebase_version": "v3.0", "features": {"front": 1}}',
        b'{"codebase_version": "v3.0", "features": {"front": {"dtype": "video", "shape": [1, 2], "info": []}}}',
    ],
)
def test_odd_metadata_is_refused_in_the_same_words(copied: Path, content: bytes) -> None:
    (copied / "meta" / "info.json").write_bytes(content)
    same_refusal(copied)


def test_nothing_outside_is_read(copied: Path, tmp_path: Path) -> None:
    info = copied / "meta" / "info.json"
    info.rename(tmp_path / "info.json")
    info.symlink_to(tmp_path / "info.json")
    assert "outside of it; refusing to read it" in same_refusal(copied)


def same_refusal(root: Path) -> str:
    """What is said of a dataset, before LeRobot is imported and after."""
    said = []
    for refuses in (described, open_source):
        with pytest.raises(DatasetError) as error:
            refuses("local/copied", root)
        said.append(str(error.value))
    assert said[0] == said[1]
    return said[0]
