"""The parquet rows of one episode, bit for bit, once they are what the metadata says."""

from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.core.errors import DatasetError, EpisodeError, first_line
from lerobot_msdyn.dataset.checks import PICTURE_DTYPES, TEXT_DTYPES, place_problem, regular_file

TIMESTAMP_TOLERANCE_S = 1e-4  # LeRobot's
KEPT_S = TIMESTAMP_TOLERANCE_S / 2  # from the grid, up to which a row's time is kept; LeRobot rounds once more
FILES_KEPT = 256
FILES_OPEN = 4  # whose list of row groups is kept, up to 20 MB each
KINDS = {"b": "b", "i": "iu", "u": "iu", "f": "fiu"}  # kind of a feature's dtype -> kinds that its cells may have


def read_rows(meta: LeRobotDatasetMetadata, index: int) -> pa.Table:
    """The rows of one episode, in order.

    Raises:
        EpisodeError: the data file is absent or damaged, or its rows are not what the metadata says.
    """
    where = f"{meta.repo_id} episode {index}"
    row = meta.episodes[index]
    problem = place_problem(row, meta.video_keys)
    if problem is not None:
        raise EpisodeError(f"{where}: meta/episodes says that {problem}")
    expected = int(row["length"])
    files = [source_file(meta, index, file) for file in data_files(meta, index)]
    path = files[0]
    try:
        rows = pa.concat_tables([_read(file, index) for file in files])
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
        raise EpisodeError(f"{where}: {path} cannot be read ({first_line(error)})") from error
    if rows.num_rows != expected or expected == 0:
        raise EpisodeError(f"{where}: {path} has {rows.num_rows} rows; expected {expected}")
    columns = {key for key, feature in meta.features.items() if feature["dtype"] != "video"}
    if columns != set(rows.column_names):
        lacking, unknown = columns - set(rows.column_names), set(rows.column_names) - columns
        raise EpisodeError(
            f"{where}: {path} lacks the columns [{', '.join(sorted(lacking))}] and has [{', '.join(sorted(unknown))}], "
            "which meta/info.json does not list"
        )
    rows = rows.sort_by("frame_index") if pa.types.is_integer(rows["frame_index"].type) else rows
    problem = _rows_problem(rows, meta)
    if problem is not None:
        raise EpisodeError(f"{where}: in {path}, {problem}")
    return rows


def read_columns(meta: LeRobotDatasetMetadata, index: int, keys: Sequence[str]) -> dict[str, np.ndarray]:
    """Some numeric columns [t, ...] of one episode, in order, where no more of it is needed.

    Raises:
        EpisodeError: they cannot be read, or there is not one row for each frame.
    """
    where = f"{meta.repo_id} episode {index}"
    problem = place_problem(meta.episodes[index], meta.video_keys)
    if problem is not None:
        raise EpisodeError(f"{where}: meta/episodes says that {problem}")
    files = [source_file(meta, index, file) for file in data_files(meta, index)]
    try:
        rows = pa.concat_tables([_read(file, index, [*keys, "frame_index"]) for file in files]).sort_by("frame_index")
        columns = {key: values_of(rows, key, meta.features[key]) for key in keys}
    except (OSError, ValueError, KeyError, TypeError, OverflowError, pa.ArrowException) as error:
        raise EpisodeError(f"{where}: {files[0]} cannot be read ({first_line(error)})") from error
    if rows.num_rows != int(meta.episodes[index]["length"]):
        raise EpisodeError(f"{where}: {files[0]} has {rows.num_rows} rows; expected {meta.episodes[index]['length']}")
    return columns


def data_files(meta: LeRobotDatasetMetadata, index: int) -> list[Path]:
    """The data files, relative to the dataset, that hold the rows of an episode.

    That is the one that its metadata names. Where that one does not hold them, the others are looked through: LeRobot
    reads them all.
    """
    named, length = meta.get_data_file_path(index), int(meta.episodes[index]["length"])
    if _rows_in(meta.root, named)[index] == length:
        return [named]
    others = [path.relative_to(meta.root) for path in sorted((meta.root / "data").glob("*/*.parquet"))]
    found = {path: _rows_in(meta.root, path)[index] for path in others}
    return [path for path, count in found.items() if count] if sum(found.values()) == length else [named]


def _read(path: Path, episode: int, columns: Sequence[str] | None = None) -> pa.Table:
    """The rows of one episode in a data file; of its row groups, only those that can hold them are read.

    `columns`: which of the file's are needed; default: all.
    """
    read = None if columns is None else [*columns, "episode_index"]
    about = path.stat()
    metadata, spans = _layout(path, about.st_mtime_ns, about.st_size)
    groups = [number for number, span in enumerate(spans) if span is None or span[0] <= episode <= span[1]]
    with pq.ParquetFile(path, metadata=metadata) as file:
        rows = file.read_row_groups(groups, columns=read)
    return rows.filter(pc.equal(rows["episode_index"], episode))


@lru_cache(FILES_OPEN)
def _layout(path: Path, changed_ns: int, size: int) -> tuple[pq.FileMetaData, list[tuple[int, int] | None]]:
    """What a data file says of itself, and the first and last episode of each of its row groups, if known.

    It is read once: a file that LeRobot records has a row group per episode, thousands of them.
    """
    metadata = pq.read_metadata(path)
    leaves = [metadata.schema.column(number).path for number in range(len(metadata.schema))]  # pictures have two
    column = leaves.index("episode_index") if "episode_index" in leaves else -1
    spans: list[tuple[int, int] | None] = []
    for number in range(metadata.num_row_groups):
        about = metadata.row_group(number).column(column).statistics if column >= 0 else None
        if about is None or not about.has_min_max or not isinstance(about.min, int):
            spans.append(None)
        else:
            spans.append((about.min, about.max))
    return metadata, spans


def _rows_in(root: Path, name: Path) -> Counter[int]:
    """How many rows of each episode a data file holds; none if it cannot be read."""
    try:
        path = regular_file(root, name)
        about = path.stat()
    except (OSError, DatasetError):
        return Counter()
    return _counted(path, about.st_mtime_ns, about.st_size)


@lru_cache(FILES_KEPT)
def _counted(path: Path, changed_ns: int, size: int) -> Counter[int]:
    try:
        return Counter(pq.read_table(path, columns=["episode_index"])["episode_index"].to_pylist())
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowException):
        return Counter()


def off_grid_s(rows: pa.Table, fps: int | float) -> float:
    """How far the recorded times of an episode are from frame_index / fps at most, s."""
    return float(np.abs(rows["timestamp"].to_numpy() - _grid(rows, fps)).max())


def on_grid(rows: pa.Table, fps: int | float) -> pa.Table:
    """The rows with frame_index / fps as their times, where the recorded ones are too far off for LeRobot to read."""
    if off_grid_s(rows, fps) <= KEPT_S:
        return rows
    position = rows.column_names.index("timestamp")
    field = rows.schema.field(position)
    return rows.set_column(position, field, [pa.array(_grid(rows, fps), field.type)])


def _grid(rows: pa.Table, fps: int | float) -> np.ndarray:
    """frame_index / fps in the type of the recorded times, [t] s."""
    return (np.arange(rows.num_rows) / fps).astype(rows["timestamp"].to_numpy().dtype)


def source_file(meta: LeRobotDatasetMetadata, index: int, relative: Path) -> Path:
    """A file that an episode lies in.

    Raises:
        EpisodeError: it is absent, no file, or outside of the dataset.
    """
    try:
        return regular_file(meta.root, relative)
    except DatasetError as error:
        raise EpisodeError(f"{meta.repo_id} episode {index}: {error}") from error


def files_problem(meta: LeRobotDatasetMetadata, index: int) -> str:
    """Why the files of an episode cannot be read, as far as that is seen without opening them; empty if they can."""
    try:
        problem = place_problem(meta.episodes[index], meta.video_keys)
        if problem is not None:
            return f"{meta.repo_id} episode {index}: meta/episodes says that {problem}"
        for path in [*data_files(meta, index), *(meta.get_video_file_path(index, key) for key in meta.video_keys)]:
            source_file(meta, index, path)
    except EpisodeError as error:
        return str(error)
    return ""


def task_of(meta: LeRobotDatasetMetadata, rows: pa.Table) -> str:
    """What the robot was told to do in the first row."""
    tasks = meta.tasks
    return str(tasks.index[tasks["task_index"] == rows["task_index"][0].as_py()][0])


def values_of(rows: pa.Table, key: str, feature: dict[str, Any]) -> np.ndarray:
    """A numeric column [t, ...] in the type that its feature names."""
    return np.asarray(rows[key].to_pylist(), dtype=feature["dtype"])


def _rows_problem(rows: pa.Table, meta: LeRobotDatasetMetadata) -> str | None:
    count = rows.num_rows
    for key, feature in meta.features.items():
        if feature["dtype"] in PICTURE_DTYPES + TEXT_DTYPES:
            continue
        kind = np.asarray(rows[key].to_pylist()[:1]).dtype.kind if rows[key].null_count == 0 else "O"
        if kind not in KINDS[np.dtype(feature["dtype"]).kind] + "O":
            return f"{key} holds {rows[key].type}; meta/info.json says {feature['dtype']}"
        try:
            values = values_of(rows, key, feature)
        except (TypeError, ValueError, OverflowError):
            return f"{key} has empty or uneven cells; expected {feature['dtype']} of shape {list(feature['shape'])}"
        shape = tuple(feature["shape"])
        if values.shape[1:] != shape and not (shape == (1,) and values.ndim == 1):
            return f"{key} has shape {list(values.shape[1:])}; expected {list(shape)}"
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            bad = int((~np.isfinite(values).reshape(count, -1)).any(1).sum())
            return f"{key} is not a number in {bad} of {count} rows; remove this episode from the source, or repair it"
    for key in meta.image_keys:
        if not pa.types.is_struct(rows[key].type) or {"bytes", "path"} - {item.name for item in rows[key].type}:
            return f"{key} holds {rows[key].type}; expected images"
    if rows["frame_index"].to_pylist() != list(range(count)):
        return f"frame_index does not go from 0 to {count - 1}"
    if not pa.types.is_floating(rows["timestamp"].type):
        return f"timestamp holds {rows['timestamp'].type}; expected seconds as floating-point numbers"
    listed = set(meta.tasks["task_index"].tolist())
    unknown = set(pc.unique(rows["task_index"]).to_pylist()) - listed
    return f"task_index is {min(unknown)}; meta/tasks.parquet has no such task" if unknown else None
