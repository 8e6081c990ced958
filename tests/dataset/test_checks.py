"""Metadata that lies: named in one line, or harmless."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lerobot_msdyn.core.errors import DatasetError, EpisodeError
from lerobot_msdyn.dataset.checks import check_metadata, inside, picture_size, template_problem
from lerobot_msdyn.dataset.read import open_source
from lerobot_msdyn.dataset.rows import read_rows

FRONT = "observation.images.front"


@pytest.fixture
def root(desk: Path, tmp_path: Path) -> Path:
    """A copy of the metadata."""
    shutil.copytree(desk / "meta", tmp_path / "ds" / "meta")
    return tmp_path / "ds"


def change(root: Path, *path: str, to: Any) -> None:
    """Set one value of info.json."""
    file = root / "meta" / "info.json"
    content = json.loads(file.read_text())
    target = content
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = to
    file.write_text(json.dumps(content))


def test_real_metadata_is_fine(desk: Path, image_desk: Path) -> None:
    check_metadata(desk)
    check_metadata(image_desk)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (["fps"], -3, "fps is -3; expected a number above 0"),
        (["fps"], float("nan"), "fps is nan"),
        (["total_frames"], 10**12, "lengths are .* add up to .* 1000000000000"),
        (["total_episodes"], 2, "3 episodes, .*; expected 0 to 1"),
        (["total_tasks"], 7, r"tasks.parquet: expected .* from 0 to 6"),
        (["total_tasks"], 10**12, r"tasks.parquet: expected .* from 0 to 999999999999"),
        (["data_path"], "../../../etc/{chunk_index}-{file_index}", "leaves the dataset's folder"),
        (["data_path"], "/etc/passwd", "leaves the dataset's folder"),
        (["data_path"], "{chunk_index.__class__.__mro__}", "is not one of chunk_index, file_index"),
        (["data_path"], "{chunk_index:99999999999d}", "has the form"),
        (["video_path"], "{video_key!r}", "has the form"),
        (["video_path"], None, "is no path"),
        (["features"], [], r"features is \[\]"),
        (["features", FRONT, "shape"], [10**9, 10**9, 3], "expected a height and width up to"),
        (["features", FRONT, "shape"], [48, 64], "expected a height and width up to"),
        (["features", FRONT, "dtype"], "object", "has dtype 'object'"),
        (["features", "action", "shape"], [-1], r"has shape \[-1\]"),
        (["features", "../../evil"], {"dtype": "video", "shape": [48, 64, 3]}, "a name that no file can have"),
        (["features", FRONT, "info", "video.extra_options"], {"x265-params": "csv=/tmp/x"}, "encoder options"),
        (["features", FRONT, "info", "video.codec"], ["h264"], "expected a short text or a number"),
    ],
)
def test_lies_are_named(root: Path, path: list[str], value: Any, message: str) -> None:
    change(root, *path, to=value)
    with pytest.raises(DatasetError, match=message) as caught:
        check_metadata(root)
    assert "\n" not in str(caught.value)


def test_files_that_are_not_what_their_names_say(root: Path) -> None:
    info = (root / "meta" / "info.json").read_bytes()
    for name in ("meta/info.json", "meta/tasks.parquet", "meta/episodes/chunk-000/file-000.parquet"):
        path = root / name
        good = path.read_bytes()
        for bad in (b"", info[:50], b"PAR1", good[: len(good) // 2], b"[" * 100_000):
            path.write_bytes(bad)
            with pytest.raises(DatasetError):
                check_metadata(root)
        path.unlink()
        os.mkfifo(path)
        with pytest.raises(DatasetError, match="is not a file"):
            check_metadata(root)
        path.unlink()
        with pytest.raises(DatasetError, match=r"is absent|holds no"):
            open_source("local/ds", root)
        path.write_bytes(good)
    check_metadata(root)


def test_tasks_that_are_no_text(root: Path) -> None:
    path = root / "meta" / "tasks.parquet"
    table = pq.read_table(path)
    for bad in ([float("nan")] * len(table), [3] * len(table)):
        pq.write_table(table.set_column(table.column_names.index("task"), "task", pa.array(bad)), path)
        with pytest.raises(DatasetError, match=r"expected a text and a task_index"):
            check_metadata(root)


def test_an_episode_table_that_lacks_a_column(root: Path) -> None:
    path = next((root / "meta" / "episodes").rglob("*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.drop_columns([f"videos/{FRONT}/file_index"]), path)
    with pytest.raises(DatasetError, match=f"lacks the columns videos/{FRONT}/file_index"):
        check_metadata(root)


def test_links_may_lead_into_the_hub_cache_only(tmp_path: Path) -> None:
    snapshot, blobs = tmp_path / "repo" / "snapshots" / "abc", tmp_path / "repo" / "blobs"
    for folder in (snapshot, blobs):
        folder.mkdir(parents=True)
    (blobs / "123").write_text("x")
    (tmp_path / "secret").write_text("x")
    (snapshot / "good").symlink_to("../../blobs/123")
    (snapshot / "bad").symlink_to("../../../secret")
    assert inside(snapshot, "good").read_text() == "x"
    with pytest.raises(DatasetError, match="outside of it"):
        inside(snapshot, "bad")
    with pytest.raises(DatasetError, match="outside of it"):
        inside(blobs, "../../secret")


def test_channels_first_or_last() -> None:
    assert picture_size({"shape": [48, 64, 3], "names": ["height", "width", "channels"]}) == (48, 64, 3)
    assert picture_size({"shape": [3, 48, 64], "names": ["channels", "height", "width"]}) == (48, 64, 3)
    assert picture_size({"shape": (1, 48, 64), "names": None}) == (48, 64, 1)
    assert picture_size({"shape": (3, 4, 3)}) == (3, 4, 3)


def test_templates() -> None:
    fields = {"chunk_index", "file_index"}
    assert template_problem("data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", fields) is None
    for bad in (
        "",
        3,
        "{",
        "{}",
        "{0}",
        "a/../../b",
        "~/x",
        "\\\\server\\x",
        "{chunk_index:>9}",
        "{chunk_index!s}",
        "a\0b",
    ):
        assert template_problem(bad, fields) is not None, bad


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, item in items for place in ((*path, key), *places(item, (*path, key)))]


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=5,
)


@pytest.fixture(params=["recorded here", "g1_v30"])
def original(request: pytest.FixtureRequest) -> Path:
    """A dataset whose metadata LeRobot wrote."""
    if request.param == "g1_v30":
        return request.getfixturevalue("shared_data") / "real" / "g1_v30"
    return request.getfixturevalue("desk")


@pytest.fixture
def copied(original: Path, tmp_path: Path) -> Path:
    """A copy of its metadata that can be written to."""
    shutil.copytree(original / "meta", tmp_path / "copied" / "meta", copy_function=shutil.copyfile)
    return tmp_path / "copied"


def assert_refused_or_harmless(root: Path) -> None:
    """What is accepted names files inside the dataset only; what is not is refused in one line."""
    try:
        source = open_source("local/ds", root)
    except DatasetError as error:
        message = str(error)
        assert "\n" not in message
        return
    for index in range(source.total_episodes):
        with pytest.raises(EpisodeError) as caught:  # there is no data/
            read_rows(source, index)
        message = str(caught.value)
        assert "\n" not in message
        if "meta/episodes says that" not in message:
            paths = [source.get_data_file_path(index)]
            paths += [source.get_video_file_path(index, key) for key in source.video_keys]
            assert all((root / path).resolve().is_relative_to(root) for path in paths)


many = settings(
    deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.differing_executors]
)


@settings(many, max_examples=100)
@given(data=st.data())
def test_any_change_of_info_is_refused_or_harmless(original: Path, copied: Path, data: st.DataObject) -> None:
    content = json.loads((original / "meta" / "info.json").read_text())
    *parents, last = data.draw(st.sampled_from(places(content)))
    target = content
    for key in parents:
        target = target[key]
    target[last] = data.draw(json_values | st.sampled_from(["../x", "/x", "{chunk_index.real}", "{file_index:9999d}"]))
    (copied / "meta" / "info.json").write_text(json.dumps(content))
    assert_refused_or_harmless(copied)


cells = st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats() | st.text(max_size=20)


@settings(many, max_examples=100)
@given(data=st.data())
def test_any_change_of_a_table_is_refused_or_harmless(original: Path, copied: Path, data: st.DataObject) -> None:
    """A cell or a whole column of the tables of tasks and episodes becomes something else."""
    names = sorted(path.relative_to(original) for path in (original / "meta").rglob("*.parquet"))
    name = data.draw(st.sampled_from(names))
    table = pq.read_table(original / name)
    column = data.draw(st.sampled_from([key for key in table.column_names if not key.startswith("stats/")]))
    values = table[column].to_pylist()
    chosen = data.draw(st.sampled_from([slice(0, 1), slice(len(values) - 1, None), slice(None)]))
    new = data.draw(cells | st.lists(cells, max_size=2))
    values[chosen] = [new] * len(values[chosen])
    try:
        array = pa.array(values)
    except (pa.ArrowException, TypeError, ValueError, OverflowError):
        array = pa.array([str(value) for value in values])
    pq.write_table(table.set_column(table.column_names.index(column), column, array), copied / name)
    assert_refused_or_harmless(copied)
    shutil.copyfile(original / name, copied / name)
