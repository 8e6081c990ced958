"""Datasets of every kind go through reading and writing with all their values."""

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.language import (
    language_events_arrow_type,
    language_feature_info,
    language_persistent_arrow_type,
)

from lerobot_msdyn.core.config import CameraConfig
from lerobot_msdyn.dataset.encode import encode_image
from lerobot_msdyn.dataset.provenance import SOURCE_VARIANT, Provenance
from lerobot_msdyn.dataset.read import open_source, read_colour, read_episode
from lerobot_msdyn.dataset.rows import read_rows
from lerobot_msdyn.dataset.write import NewEpisode, OutputDataset

FRONT, SIDE = "observation.images.front", "observation.images.side"
LENGTHS = (4, 5, 3, 2)
AXES = ["height", "width", "channels"]
RECORDED: dict[str, dict[str, Any]] = {
    "action": {"dtype": "float32", "shape": (2,), "names": None},
    "observation.matrix": {"dtype": "float64", "shape": (2, 3), "names": None},
    "observation.counts": {"dtype": "int16", "shape": (3,), "names": None},
    "success": {"dtype": "bool", "shape": (1,), "names": None},
    "note": {"dtype": "string", "shape": (1,), "names": None},
}


def record(root: Path, dtype: str, sizes: dict[str, tuple[int, int]], fps: int = 7, *, short: bool = False) -> None:
    """A dataset of several tasks and short episodes, each in files of its own.

    `short` makes the first a single frame; LeRobot cannot record that together with a feature of nested shape.
    """
    recorded = {key: value for key, value in RECORDED.items() if len(value["shape"]) == 1 or not short}
    pictures = {key: {"dtype": dtype, "shape": (*size, 3), "names": AXES} for key, size in sizes.items()}
    dataset = LeRobotDataset.create(
        "local/odd",
        fps,
        recorded | pictures,
        root=root,
        robot_type="odd",
        use_videos=dtype == "video",
        video_backend="pyav",
    )
    dataset.meta.info.video_files_size_in_mb = dataset.meta.info.data_files_size_in_mb = 1e-6
    rng = np.random.default_rng(0)
    for episode, length in enumerate((1, *LENGTHS[1:]) if short else LENGTHS):
        for t in range(length):
            frame: dict[str, Any] = {
                "action": rng.normal(size=2).astype(np.float32),
                "observation.matrix": rng.normal(size=(2, 3)),
                "observation.counts": rng.integers(-9, 9, 3).astype(np.int16),
                "success": np.array([t % 2 == 0]),
                "note": f"episode {episode}, ünïcode {t}",
                "task": f"task {episode % 2}",
            }
            frame = {key: value for key, value in frame.items() if key in recorded or key == "task"}
            for key, (height, width) in sizes.items():
                low = rng.integers(0, 255, (3, 4, 3)).astype(np.uint8)
                frame[key] = cv2.resize(low, (width, height), interpolation=cv2.INTER_CUBIC)
            dataset.add_frame(frame)
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()


def turned(root: Path, out: Path) -> tuple[LeRobotDataset, LeRobotDataset]:
    """The source, and an output with each episode as it is and with the front camera upside down."""
    source = open_source("local/odd", root)
    with OutputDataset(source, "local/turned", out) as output:
        new = []
        for index in range(source.total_episodes):
            new.append(NewEpisode(index, Provenance("local/odd", index, SOURCE_VARIANT, 0)))
            rgb = read_colour(source, index, FRONT, read_rows(source, index)).flip(1).numpy()
            new.append(output.stage(index, 0, ({FRONT: frame} for frame in rgb), Provenance("local/odd", index, 0, 0)))
        output.finish(new, "")
    return (
        LeRobotDataset("local/odd", root=root, video_backend="pyav"),
        LeRobotDataset("local/turned", root=out, video_backend="pyav"),
    )


def assert_carried(source: LeRobotDataset, output: LeRobotDataset, tolerance: float) -> None:
    position = 0
    for number in range(output.num_episodes):
        row = source.meta.episodes[number // 2]
        for i in range(row["length"]):
            old, new = source[row["dataset_from_index"] + i], output[position]
            assert old.keys() == new.keys()
            for key in set(old) - {"index", "episode_index"}:
                same = old[key] == new[key]
                if key == FRONT and number % 2:
                    assert old[key].shape == new[key].shape
                    assert (old[key].flip(1) - new[key])[:3].abs().mean() < tolerance
                else:
                    assert bool(same.all()) if hasattr(same, "all") else same, (number, i, key)
            position += 1
    assert position == len(output) == 2 * len(source)


@pytest.mark.parametrize("dtype", ["video", "image"])
def test_every_feature_is_carried(dtype: str, tmp_path: Path) -> None:
    record(tmp_path / "odd", dtype, {FRONT: (48, 64), SIDE: (36, 80)})
    source, output = turned(tmp_path / "odd", tmp_path / "out")
    assert len(list((tmp_path / "odd" / "data").rglob("*.parquet"))) == len(LENGTHS)
    assert_carried(source, output, 0.05 if dtype == "video" else 1e-6)
    assert output.meta.tasks.equals(source.meta.tasks)
    assert "note" not in output.meta.stats
    for name in ("min", "max", "mean", "std"):
        old, new = (each.meta.stats["observation.matrix"][name] for each in (source, output))
        np.testing.assert_allclose(new, old, rtol=1e-6, err_msg=name)


def test_odd_widths(tmp_path: Path) -> None:
    record(tmp_path / "odd", "video", {FRONT: (47, 65), SIDE: (35, 81)})
    source, output = turned(tmp_path / "odd", tmp_path / "out")
    assert_carried(source, output, 0.05)
    assert output[0][FRONT].shape == (3, 47, 65)


@pytest.mark.parametrize("channels", [1, 4])
def test_grey_and_four_channel_images(channels: int, tmp_path: Path) -> None:
    root = tmp_path / "odd"
    record(root, "image", {FRONT: (48, 64)})
    for path in sorted((root / "data").rglob("*.parquet")):
        table = pq.read_table(path)
        cells = []
        for cell in table[FRONT].to_pylist():
            image = cv2.imdecode(np.frombuffer(cell["bytes"], np.uint8), cv2.IMREAD_COLOR)
            assert image is not None
            grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            cells.append({"bytes": encode_image(grey, ".png"), "path": cell["path"]})
            if channels == 4:
                ok, content = cv2.imencode(".png", np.dstack([image, np.full(image.shape[:2], 255, np.uint8)]))
                assert ok
                cells[-1]["bytes"] = content.tobytes()
        position = table.column_names.index(FRONT)
        table = table.set_column(
            position, table.schema.field(position), pa.array(cells, table.schema.field(FRONT).type)
        )
        pq.write_table(table, path)
    change(root, lambda info: info["features"][FRONT].update(shape=[48, 64, channels]))
    source, output = turned(root, tmp_path / "out")
    assert output[1][FRONT].shape == source[0][FRONT].shape == (channels, 48, 64)
    assert_carried(source, output, 2 / 255)
    assert output.meta.stats[FRONT]["mean"].shape == (min(channels, 3), 1, 1)


def test_language_columns(tmp_path: Path) -> None:
    root = tmp_path / "odd"
    record(root, "image", {FRONT: (48, 64)})
    row = {"role": "user", "content": "fold it", "style": "task_aug", "timestamp": 0.0}
    kinds = {"language_persistent": language_persistent_arrow_type(), "language_events": language_events_arrow_type()}
    for path in sorted((root / "data").rglob("*.parquet")):
        table = pq.read_table(path)
        for name, kind in kinds.items():
            table = table.append_column(name, one_each(kind, row, len(table)))
        pq.write_table(table.replace_schema_metadata(None), path)
    listed = {key: value | {"shape": list(value["shape"])} for key, value in language_feature_info().items()}
    change(root, lambda info: info["features"].update(listed))
    source = open_source("local/odd", root)
    with OutputDataset(source, "local/out", tmp_path / "out") as output:
        output.finish([NewEpisode(2, Provenance("local/odd", 2, SOURCE_VARIANT, 0))], "")
    old, new = read_rows(source, 2), read_rows(open_source("local/out", tmp_path / "out"), 0)
    for name in kinds:
        assert new[name].to_pylist() == old[name].to_pylist() != []
        assert new[name].type == old[name].type


def one_each(kind: pa.ListType, row: dict[str, Any], count: int) -> pa.Array:
    """Lists of one struct each; what is neither text nor a number (JSON of tool calls) is empty."""
    columns = []
    for item in kind.value_type:
        plain = pa.types.is_string(item.type) or pa.types.is_floating(item.type)
        columns.append(pa.array([row.get(item.name)] * count, item.type) if plain else pa.nulls(count, item.type))
    rows = pa.StructArray.from_arrays(columns, fields=list(kind.value_type))
    return pa.ListArray.from_arrays(pa.array(range(count + 1), pa.int32()), rows, type=kind)


def test_a_rate_that_is_no_whole_number(desk: Path, tmp_path: Path) -> None:
    from lerobot_msdyn.dataset.video import VideoFile, encoder_of, frame_rate, problem_of

    assert (frame_rate(29.97), frame_rate(30000 / 1001)) == (Fraction(2997, 100), Fraction(30000, 1001))
    encoder = encoder_of(open_source("local/desk", desk).features[FRONT], FRONT)
    with VideoFile(tmp_path / "a.mp4", 29.97, encoder) as file:
        for level in range(300):
            file.add(np.full((48, 64, 3), level % 200, np.uint8))
    assert problem_of(tmp_path / "a.mp4", 300, 30000 / 1001, (64, 48)) is None


def test_one_frame_is_an_episode(tmp_path: Path) -> None:
    record(tmp_path / "odd", "video", {FRONT: (48, 64)}, short=True)
    source, output = turned(tmp_path / "odd", tmp_path / "out")
    assert_carried(source, output, 0.05)
    episode = read_episode(open_source("local/odd", tmp_path / "odd"), 0, [FRONT], CameraConfig())
    assert len(episode) == 1
    assert episode.task == "task 0"


def change(root: Path, edit: Any) -> None:
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    edit(info)
    path.write_text(json.dumps(info))
