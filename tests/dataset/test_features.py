"""What older recorders left out of features is filled in, so that LeRobot's trainer can use the output."""

import json
import shutil
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.dataset.features import completed
from lerobot_msdyn.dataset.provenance import SOURCE_VARIANT, Provenance
from lerobot_msdyn.dataset.read import open_source, read_depth
from lerobot_msdyn.dataset.rows import read_rows
from lerobot_msdyn.dataset.write import NewEpisode, OutputDataset

FRONT = "observation.images.front"
DEPTH = f"{FRONT}_depth"


@pytest.mark.parametrize("names", [None, [], ["rgb"], {"axes": ["height", "width", "channels"]}])
def test_names_of_pictures(names: Any) -> None:
    assert completed({"dtype": "video", "shape": [48, 64, 3], "names": names})["names"] == [
        "height",
        "width",
        "channels",
    ]
    assert completed({"dtype": "image", "shape": [3, 48, 64], "names": names})["names"] == [
        "channels",
        "height",
        "width",
    ]
    assert completed({"dtype": "float32", "shape": [6]})["names"] is None


def test_what_is_there_stays() -> None:
    feature = {"dtype": "video", "shape": [3, 4, 3], "names": ["channel", "height", "width"], "info": {"video.fps": 5}}
    assert completed(feature) == feature


def stripped(feature: dict[str, Any]) -> None:
    """The feature as LeRobot 0.6.2 spells depth."""
    info = feature.pop("info")
    info.pop("is_depth_map")
    feature["video_info"] = info | {"video.is_depth_map": True}


def test_an_output_lacks_nothing(desk: Path, tmp_path: Path) -> None:
    root = tmp_path / "old"
    shutil.copytree(desk, root)
    file = root / "meta" / "info.json"
    info = json.loads(file.read_text())
    for feature in info["features"].values():
        feature["names"] = None
    stripped(info["features"][DEPTH])
    file.write_text(json.dumps(info))
    stats = json.loads((root / "meta" / "stats.json").read_text())
    del stats[FRONT]
    (root / "meta" / "stats.json").write_text(json.dumps(stats))
    for path in (root / "meta" / "episodes").rglob("*.parquet"):
        table = pq.read_table(path)
        pq.write_table(table.drop_columns([name for name in table.column_names if name.startswith("stats/")]), path)
    source = open_source("local/old", root)
    with OutputDataset(source, "local/new", tmp_path / "new") as output:
        output.finish([NewEpisode(1, Provenance("local/old", 1, SOURCE_VARIANT, 0))], "")
    new = LeRobotDataset("local/new", root=tmp_path / "new", video_backend="pyav")
    assert dataset_to_policy_features(new.meta.features)[FRONT].shape == (3, 48, 64)
    assert new.meta.stats[FRONT]["mean"].shape == (3, 1, 1)
    assert set(new.meta.stats) >= set(new.meta.camera_keys)
    meta = open_source("local/desk", desk)
    before = read_depth(meta, 1, DEPTH, read_rows(meta, 1))[0]
    assert float(new.meta.stats[DEPTH]["mean"].item()) == pytest.approx(
        float(meta.stats[DEPTH]["mean"].item()), rel=0.1
    )
    again = open_source("local/new", tmp_path / "new")
    assert (read_depth(again, 0, DEPTH, read_rows(again, 0))[0] - before).abs().max() < 0.003


def test_encoder_settings_in_the_older_place_are_checked_as_well(desk: Path, tmp_path: Path) -> None:
    shutil.copytree(desk / "meta", tmp_path / "evil" / "meta")
    file = tmp_path / "evil" / "meta" / "info.json"
    info = json.loads(file.read_text())
    info["features"][DEPTH]["video_info"] = {"video.extra_options": {"x265-params": "csv=/tmp/x"}}
    file.write_text(json.dumps(info))
    with pytest.raises(DatasetError, match="encoder options"):
        open_source("local/evil", tmp_path / "evil")
