"""Datasets of version v2.1 are converted in a copy."""

import json
import logging
from pathlib import Path

import pytest
import torch

from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.dataset import convert
from lerobot_msdyn.dataset.convert import converted_copy, named_as_given
from lerobot_msdyn.dataset.read import open_source, read_colour
from lerobot_msdyn.dataset.rows import read_rows
from lerobot_msdyn.dataset.select import colour_cameras


def legacy(root: Path, **changes: object) -> Path:
    """The metadata of a dataset of version v2.1, without any data."""
    info = {"codebase_version": "v2.1", "fps": 10, "features": {"action": {"dtype": "float32", "shape": [2]}}}
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(info | changes))
    return root


def test_what_cannot_be_converted(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"version v2\.0; --convert takes v2\.1 only"):
        converted_copy("local/a", legacy(tmp_path / "a", codebase_version="v2.0"), tmp_path / "work")
    evil = {"../../../evil": {"dtype": "video", "shape": [4, 4, 3]}}
    with pytest.raises(DatasetError, match="a name that no file can have"):
        converted_copy("local/b", legacy(tmp_path / "b", features=evil), tmp_path / "work")
    assert not (tmp_path / "work").exists()
    with pytest.raises(DatasetError, match="cannot be converted by LeRobot's script"):
        converted_copy("local/c", legacy(tmp_path / "c"), tmp_path / "work")
    assert not (tmp_path / "work" / "converted").exists()


def test_messages_name_the_files_of_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root, work = legacy(tmp_path / "a"), tmp_path / "work"

    def fails(repo_id: str, root: Path, **_: object) -> None:
        raise FileNotFoundError(f"no {root / 'data' / 'chunk-000' / 'episode_000003.parquet'}")

    monkeypatch.setattr(convert, "convert_dataset", fails)
    with pytest.raises(DatasetError) as caught:
        converted_copy("local/a", root, work)
    assert f"no {root}/data/chunk-000/episode_000003.parquet" in str(caught.value)
    assert str(work) not in str(caught.value)
    assert named_as_given(f"{work}/converted/meta is absent", work, root) == f"{root} (converted)/meta is absent"


def test_a_link_out_of_the_source_is_not_followed(tmp_path: Path) -> None:
    root = legacy(tmp_path / "a")
    (tmp_path / "secret").write_text("x")
    (root / "meta" / "tasks.jsonl").symlink_to(tmp_path / "secret")
    with pytest.raises(DatasetError, match="outside of it"):
        converted_copy("local/a", root, tmp_path / "work")


def test_only_lerobot_is_quiet_and_only_while_it_converts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def chatty(repo_id: str, root: Path, **_: object) -> None:
        logging.info("a line per file")
        logging.getLogger("lerobot.datasets.utils").warning("a line per field")
        logging.getLogger("of_the_user").warning("wait")
        logging.error("trouble")

    monkeypatch.setattr(convert, "convert_dataset", chatty)
    with caplog.at_level("INFO"):
        converted_copy("local/a", legacy(tmp_path / "a"), tmp_path / "work")
        logging.getLogger("lerobot.datasets.utils").warning("later")
    logged = [record.getMessage() for record in caplog.records if record.name != convert.__name__]
    assert logged == ["wait", "trouble", "later"]


@pytest.mark.slow
def test_a_real_one(shared_data: Path, tmp_path: Path) -> None:
    old = shared_data / "real" / "g1_v21"
    before = {path: path.stat().st_mtime_ns for path in old.rglob("*")}
    root = converted_copy("local/g1", old, tmp_path)
    assert converted_copy("local/g1", old, tmp_path) == root
    assert {path: path.stat().st_mtime_ns for path in old.rglob("*")} == before
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["converted", "temporary"]
    new, same = open_source("local/g1", root), open_source("local/g1", shared_data / "real" / "g1_v30")
    key = colour_cameras(new)[0]
    pictures = [read_colour(source, 1, key, read_rows(source, 1)) for source in (new, same)]
    assert torch.equal(*pictures)
