"""What a dataset's metadata must be before anything is done with it: every value may be wrong, by accident or intent.

LeRobot trusts its metadata: it formats paths with it, hands encoder options to FFmpeg, and downloads into the dataset's
own folder where a file is absent. So files and values are looked at here first, and a wrong one is named in one line.
"""

import itertools
import json
import math
import os
import re
import stat
import string
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_msdyn.core.errors import DatasetError

CODEBASE_VERSION = "v3.0"
MAX_JSON_BYTES = 64 << 20
MAX_SIDE_PX = 16_384
MAX_FPS = 1000
MAX_DIMENSIONS = 5
MAX_NAME = 150  # characters of a feature's name, which becomes a file's
PICTURE_DTYPES = ("video", "image")
TEXT_DTYPES = ("string", "language")
PATH_FIELDS = {
    "data_path": {"chunk_index", "file_index"},
    "video_path": {"video_key", "chunk_index", "file_index"},
}
PLACES = ("chunk_index", "file_index")
# Options of an encoder that name no file; others (x264's `stats`, x265's `csv`) could make it write anywhere.
SAFE_OPTIONS = {"crf", "preset", "tune", "profile", "level", "qp", "bf", "refs", "threads", "row-mt", "cpu-used"}
SAFE_PARAMS = {"lossless", "log-level", "crf", "preset", "tune", "keyint", "fast-decode", "lp", "film-grain"}
DEPTH_NUMBERS = {"video.depth_min", "video.depth_max", "video.shift"}
PARQUET_END = b"PAR1"
PARAMS_OPTIONS = {"x264-params", "x265-params", "svtav1-params"}


@dataclass(frozen=True)
class IntactEpisodes:
    """The leading episodes that are there; a recorder that was killed has listed more than it has finished."""

    listed: int  # by info.json
    count: int  # there: 0 to count - 1
    frames: int  # of these
    files: list[Path]  # finished ones of meta/episodes/
    unfinished: list[Path]

    def lost_line(self, root: Path) -> str:
        """What is lost, and what can be done; empty if nothing is."""
        if self.count == self.listed:
            return ""
        delete = "".join(f"{path.relative_to(root)} and " for path in self.unfinished)
        return (
            f"{root}: meta/info.json lists {self.listed} episodes, of which {self.count} (0 to {self.count - 1}) are "
            "there and used; most likely the recorder was killed before it wrote the others, which are lost: record "
            f"them again. For LeRobot to open the dataset, set total_episodes to {self.count} and total_frames to "
            f"{self.frames} in meta/info.json, and delete {delete}any file without a footer in data/"
        )


def check_version(root: Path) -> None:
    """Whether a dataset is of the version that this LeRobot reads.

    Raises:
        DatasetError: it is not; the way to convert it is named.
    """
    version = read_json(root, "meta/info.json").get("codebase_version")
    if version == "v2.1":
        todo = "add --convert to work on a converted copy of it (the source stays as it is)"
    elif str(version).startswith(("v1", "v2")):
        todo = "convert it to v2.1 with an older LeRobot first, then add --convert"
    else:
        todo = "use a LeRobot and an lerobot_msdyn that know this version"
    if version != CODEBASE_VERSION:
        raise DatasetError(f"{root} is a LeRobot dataset of version {version}; expected {CODEBASE_VERSION}; {todo}")


def check_metadata(root: Path) -> IntactEpisodes:
    """Look at meta/ of a dataset of version v3.0.

    Raises:
        DatasetError: a file or a value is not what it should be, or no episode is there.
    """
    info = read_json(root, "meta/info.json")
    where = root / "meta" / "info.json"
    features = check_features(info.get("features"), where)
    _check_info(info, where, has_video=any(feature["dtype"] == "video" for feature in features.values()))
    if (root / "meta" / "stats.json").exists():
        read_json(root, "meta/stats.json")
    _check_tasks(root, info["total_tasks"])
    return _check_episodes(root, info, [key for key, feature in features.items() if feature["dtype"] == "video"])


def read_json(root: Path, name: str) -> dict[str, Any]:
    """A JSON file of a dataset that holds a mapping.

    Raises:
        DatasetError: it is absent, no regular file inside the dataset, too large, or does not hold one.
    """
    path = regular_file(root, name)
    if path.stat().st_size > MAX_JSON_BYTES:
        raise DatasetError(f"{path} has {path.stat().st_size >> 20} MiB; expected at most {MAX_JSON_BYTES >> 20}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path} is not readable JSON ({type(error).__name__}: {error})") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{path} holds a {type(content).__name__}; expected a mapping")
    return content


def regular_file(root: Path, name: str | Path) -> Path:
    """A file of a dataset, at a path that may come from its metadata.

    Raises:
        DatasetError: it lies outside of the dataset, is absent, or is no regular file.
    """
    path = inside(root, name)
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        raise DatasetError(f"{root / name} is absent") from error
    if not stat.S_ISREG(mode):
        raise DatasetError(f"{root / name} is not a file")
    return path


def inside(root: Path, name: str | Path) -> Path:
    """The path itself, if what it leads to lies in the dataset's folder or in the hub cache that the folder is part of.

    Raises:
        DatasetError: it does not.
    """
    path = root / name
    try:
        target = path.resolve()
    except (OSError, ValueError, RuntimeError) as error:
        raise DatasetError(f"{path} leads nowhere ({type(error).__name__})") from error
    allowed = [root.resolve()]
    if root.resolve().parent.name == "snapshots":  # files of a hub download are links to the cache's blobs
        allowed.append(root.resolve().parent.parent / "blobs")
    if not any(target.is_relative_to(folder) for folder in allowed):
        raise DatasetError(f"the dataset in {root} names {name}, which is outside of it; refusing to read it")
    return path


def picture_size(feature: dict[str, Any]) -> tuple[int, int, int]:
    """Height, width and channels that a picture feature claims; channels may come first or last."""
    shape = [int(side) for side in feature["shape"]]
    names = [str(name) for name in feature.get("names") or []]
    first = names[0].startswith("channel") if len(names) == 3 else shape[2] not in (1, 3, 4) and shape[0] in (1, 3, 4)
    channels, height, width = shape if first else [shape[2], *shape[:2]]
    return height, width, channels


def is_whole(value: object, low: int, high: int = 2**53) -> bool:
    """Whether a value is a whole number in a range."""
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def check_features(features: Any, where: Path) -> dict[str, dict[str, Any]]:
    """The features that info.json lists, looked at.

    Raises:
        DatasetError: they are no mapping, or a name, dtype, shape or encoder setting is not what it should be.
    """
    if not isinstance(features, dict) or not features:
        raise DatasetError(f"{where}: features is {_short(features)}; expected a mapping of features")
    for key, feature in features.items():
        _check_feature(key, feature, where)
    return features


def _check_info(info: dict[str, Any], where: Path, *, has_video: bool) -> None:
    def need(holds: bool, name: str, expected: str) -> None:
        if not holds:
            raise DatasetError(f"{where}: {name} is {_short(info.get(name))}; expected {expected}")

    fps: Any = info.get("fps")
    need(_is_positive(fps) and fps <= MAX_FPS, "fps", f"a number above 0 and up to {MAX_FPS}")
    for name in ("total_episodes", "total_frames", "total_tasks"):
        need(is_whole(info.get(name), 1), name, "a whole number of at least 1")
    need("chunks_size" not in info or is_whole(info["chunks_size"], 1), "chunks_size", "a whole number of at least 1")
    for name in ("data_files_size_in_mb", "video_files_size_in_mb"):
        need(name not in info or _is_positive(info[name]), name, "a number above 0")
    need(isinstance(info.get("robot_type"), str | None), "robot_type", "text")
    need(isinstance(info.get("tools"), list | None), "tools", "a list")
    for name, fields in PATH_FIELDS.items():
        if name in info and (info[name] is not None or name == "data_path" or has_video):
            problem = template_problem(info[name], fields)
            if problem:
                raise DatasetError(f"{where}: {name} is {_short(info[name])}, {problem}")


def is_finite(value: object) -> bool:
    """Whether a value is a number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf


def _is_positive(value: Any) -> bool:
    return is_finite(value) and value > 0


def template_problem(template: object, fields: set[str]) -> str | None:
    """What is wrong with a path template; None if it names a file inside the dataset, by these fields only."""
    if not isinstance(template, str) or not template:
        return "which is no path"
    if template.startswith(("/", "\\", "~")) or ".." in re.split(r"[/\\]", template) or "\0" in template:
        return "which leaves the dataset's folder"
    try:
        parts = list(string.Formatter().parse(template))
    except ValueError as error:
        return f"which is no path template ({error})"
    for _, field, form, conversion in parts:
        if field is None:
            continue
        if field not in fields:
            return f"whose field {_short(field)} is not one of {', '.join(sorted(fields))}"
        if conversion or not re.fullmatch(r"(0?\d)?d?" if field in PLACES else "", form or ""):
            return f"whose field {field} has the form {_short(form or conversion)}"
    return None


def _check_feature(key: object, feature: object, where: Path) -> None:
    name = f"{where}: feature {_short(key)}"
    if not isinstance(key, str) or not re.fullmatch(rf"[^/\\\x00-\x1f]{{1,{MAX_NAME}}}", key) or key.strip(".") == "":
        raise DatasetError(f"{name} has a name that no file can have")
    if not isinstance(feature, dict):
        raise DatasetError(f"{name} is {_short(feature)}; expected a mapping")
    dtype, shape = feature.get("dtype"), feature.get("shape")
    if dtype not in PICTURE_DTYPES + TEXT_DTYPES and not _is_numeric(dtype):
        raise DatasetError(f"{name} has dtype {_short(dtype)}; expected video, image, string, language or a number's")
    sides = shape if isinstance(shape, list | tuple) else []
    if not 1 <= len(sides) <= MAX_DIMENSIONS or not all(is_whole(side, 1) for side in sides):
        raise DatasetError(f"{name} has shape {_short(shape)}; expected a list of 1 to {MAX_DIMENSIONS} whole numbers")
    if not isinstance(feature.get("names"), list | tuple | dict | None):
        raise DatasetError(f"{name} has names {_short(feature['names'])}; expected a list")
    info = feature.get("info")
    legacy = feature.get("video_info")
    for block in (info, legacy):
        if not isinstance(block, dict | None):
            raise DatasetError(f"{name} has info {_short(block)}; expected a mapping")
    if dtype in PICTURE_DTYPES:
        if len(sides) != 3 or max(picture_size(feature)[:2]) > MAX_SIDE_PX or picture_size(feature)[2] not in (1, 3, 4):
            raise DatasetError(
                f"{name} has shape {_short(shape)}; expected a height and width up to {MAX_SIDE_PX} and 1, 3 or 4 "
                "channels"
            )
        for block in (info, legacy):
            _check_encoder(name, block or {})


def _is_numeric(dtype: object) -> bool:
    kind = np.sctypeDict.get(dtype) if isinstance(dtype, str) else None  # np.dtype would parse any text
    return kind is not None and np.dtype(kind).kind in "biuf"


def _check_encoder(name: str, info: dict[str, Any]) -> None:
    """Whether the settings that a video was encoded with are harmless when they are used again."""
    for key, value in info.items():
        if key == "video.extra_options":
            _check_options(name, value)
        elif key in DEPTH_NUMBERS and not (value is None or is_finite(value)):
            raise DatasetError(f"{name} has {_short(key)}: {_short(value)}; expected a number")
        elif not isinstance(value, str | int | float | bool | None) or (
            isinstance(value, str) and not re.fullmatch(r"[\w .:+/-]{0,80}", value)
        ):
            raise DatasetError(f"{name} has {_short(key)}: {_short(value)}; expected a short text or a number")


def _check_options(name: str, options: object) -> None:
    for option, value in (options if isinstance(options, dict) else {"": options}).items():
        if option in PARAMS_OPTIONS and isinstance(value, str):
            pairs = [pair.partition("=")[::2] for pair in value.split(":")]
        else:
            pairs = [(option, str(value))] if option in SAFE_OPTIONS else [("", "")]
        allowed = SAFE_PARAMS if option in PARAMS_OPTIONS else SAFE_OPTIONS
        if options and not all(key in allowed and re.fullmatch(r"[\w.+-]*", text) for key, text in pairs):
            raise DatasetError(
                f"{name} has encoder options {_short(options)}; only {', '.join(sorted(SAFE_OPTIONS | SAFE_PARAMS))} "
                "are passed on: remove the others from its video.extra_options"
            )


def _check_tasks(root: Path, total: int) -> None:
    table = _read_table(regular_file(root, "meta/tasks.parquet"), None)
    indices = table["task_index"].to_pylist() if "task_index" in table.column_names else []
    texts = [
        column for column in table.columns if pa.types.is_string(column.type) or pa.types.is_large_string(column.type)
    ]
    # A recorder that is killed may have written a task that it has not counted yet.
    complete = total <= len(indices) and sorted(map(str, indices)) == sorted(map(str, range(len(indices))))
    if len(table.column_names) != 2 or len(texts) != 1 or not complete:
        raise DatasetError(
            f"{root / 'meta' / 'tasks.parquet'}: expected a text and a task_index from 0 to {total - 1} for each task, "
            "as many as info.json's total_tasks"
        )


def _check_episodes(root: Path, info: dict[str, Any], video_keys: list[str]) -> IntactEpisodes:
    folder = root / "meta" / "episodes"
    files = [regular_file(root, path.relative_to(root)) for path in sorted(folder.glob("*/*.parquet"))]
    if not files:
        raise DatasetError(f"{folder} holds no chunk-*/file-*.parquet")
    finished = list(itertools.takewhile(_is_finished, files))
    if not finished:
        raise DatasetError(
            f"{files[0]} was never finished (it has no footer), so that no episode is known: most likely the recorder "
            "was killed; record the dataset again"
        )
    columns = {"episode_index", "length", "dataset_from_index", "dataset_to_index", "tasks"}
    columns |= {f"data/{place}" for place in PLACES}
    columns |= {f"videos/{key}/{name}" for key in video_keys for name in (*PLACES, "from_timestamp", "to_timestamp")}
    tables = [_read_table(path, columns) for path in finished]
    episodes = [value for table in tables for value in table["episode_index"].to_pylist()]
    lengths = [value for table in tables for value in table["length"].to_pylist()]
    listed = info["total_episodes"]
    count = next((i for i, episode in enumerate(episodes) if episode != i), len(episodes))
    if not 0 < count <= listed or (len(episodes) >= listed and count < len(episodes)):
        raise DatasetError(
            f"{folder}: {len(episodes)} episodes, {_short(episodes)}; expected 0 to {listed - 1}, as many as "
            "info.json's total_episodes"
        )
    whole = all(is_whole(length, 0) for length in lengths)
    frames = sum(lengths[:count]) if whole else 0
    if not whole or frames > info["total_frames"] or (count == listed and frames < info["total_frames"]):
        raise DatasetError(
            f"{folder}: the episodes' lengths are {_short(lengths)}; expected whole numbers that add up to "
            f"info.json's total_frames, {info['total_frames']}"
        )
    return IntactEpisodes(listed, count, frames, finished, files[len(finished) :])


def _is_finished(path: Path) -> bool:
    """Whether a parquet file has a footer, which is written last."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(-min(size, len(PARQUET_END)), os.SEEK_END)
        return size > 2 * len(PARQUET_END) and file.read() == PARQUET_END


def _read_table(path: Path, columns: Iterable[str] | None) -> pa.Table:
    """The named columns of a parquet file, none of whose cells may be empty."""
    try:
        with pq.ParquetFile(path) as file:
            lacking = sorted(set(columns or ()) - set(file.schema_arrow.names))
            if lacking:
                raise DatasetError(f"{path} lacks the columns {', '.join(lacking)}")
            table = file.read(None if columns is None else sorted(columns))
    except (OSError, ValueError, KeyError, pa.ArrowException) as error:
        raise DatasetError(f"{path} is not a readable parquet file ({type(error).__name__})") from error
    for name in table.column_names:
        column = table[name]
        kind = str(column.type)
        number = ("int", "uint") + (("float", "double") if name.endswith("timestamp") else ())
        if name == "tasks" and columns is not None and not _is_texts(column.type):
            raise DatasetError(f"{path}: column tasks holds {column.type}; expected lists of texts")
        if column.null_count or (name not in ("tasks", "task") and columns is not None and not kind.startswith(number)):
            raise DatasetError(f"{path}: column {name} holds {column.null_count} empty cells of type {kind}")
    return table


def _is_texts(kind: pa.DataType) -> bool:
    nested = pa.types.is_list(kind) or pa.types.is_large_list(kind)
    return nested and (pa.types.is_string(kind.value_type) or pa.types.is_large_string(kind.value_type))


def place_problem(episode: dict[str, Any], video_keys: Iterable[str]) -> str | None:
    """What is wrong with the row that says where an episode lies; None if nothing is."""
    for key in [f"data/{place}" for place in PLACES] + [f"videos/{k}/{p}" for k in video_keys for p in PLACES]:
        if not is_whole(episode[key], 0, 10**6):
            return f"{key} is {_short(episode[key])}"
    for key in video_keys:
        start = episode[f"videos/{key}/from_timestamp"]
        if not (math.isfinite(start) and 0 <= start < 1e7):
            return f"videos/{key}/from_timestamp is {_short(start)}"
    return None


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
