"""Which episodes of any dataset show the same recording, found by their content.

So it holds also after other tools have merged, cut or renumbered a dataset, or lost the record that `provenance` wrote.
Re-rendered episodes have their source's rows bit for bit. So episodes whose recorded numbers (states, actions, times,
...) are the same belong together, whatever became of meta/msdyn/ on the way; where that is there, it counts as well.
"""

import hashlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.core.files import DIGEST_BYTES
from lerobot_msdyn.dataset.checks import PICTURE_DTYPES, TEXT_DTYPES
from lerobot_msdyn.dataset.provenance import read_provenance
from lerobot_msdyn.dataset.rows import read_rows, values_of

BOOKKEEPING = ("index", "episode_index", "task_index", "timestamp", "frame_index")
STATISTICS = ("mean", "std", "min", "max")


def recordings(meta: LeRobotDatasetMetadata) -> list[int]:
    """Per episode, the first episode that shows the same recording.

    Raises:
        DatasetError: the rows hold no recorded numbers, and meta/msdyn does not say where episodes come from.
    """
    provenance = provenance_of(meta)
    marks = [{digest} - {None} for digest in row_digests(meta)]
    for mark, row in zip(marks, provenance or [], strict=False):
        mark.add(f"{row['source_repo_id']} {row['source_episode']}")
    if not all(marks):
        raise DatasetError(
            f"{meta.root}: its rows hold no numbers by which recordings can be told apart, and there is no meta/msdyn/"
        )
    parents = list(range(len(marks)))  # of a forest: the root of each tree is its first episode

    def root(index: int) -> int:
        while parents[index] != index:
            parents[index] = parents[parents[index]]
            index = parents[index]
        return index

    first: dict[Any, int] = {}
    for index, mark in enumerate(marks):
        joined = {root(first[item]) for item in mark if item in first} | {index}
        for other in joined:
            parents[other] = min(joined)
        for item in mark:
            first.setdefault(item, index)
    return [root(index) for index in range(len(marks))]


def provenance_of(meta: LeRobotDatasetMetadata) -> list[dict[str, Any]] | None:
    """The rows of meta/msdyn/episodes.parquet, if there are any.

    Raises:
        DatasetError: they are not those of this dataset's episodes.
    """
    rows = read_provenance(meta.root)
    if rows is not None and len(rows) != meta.total_episodes:
        raise DatasetError(
            f"{meta.root}: meta/msdyn/episodes.parquet has {len(rows)} rows for {meta.total_episodes} episodes; "
            "write it anew with python -m lerobot_msdyn.carry"
        )
    return rows


def row_digests(meta: LeRobotDatasetMetadata) -> list[str | None]:
    """Per episode a digest of its recorded numbers; None where there are none.

    Raises:
        EpisodeError: an episode's rows are absent or damaged.
    """
    keys = [
        key
        for key, feature in sorted(meta.features.items())
        if feature["dtype"] not in PICTURE_DTYPES + TEXT_DTYPES and key not in BOOKKEEPING
    ]
    if not keys:
        return [None] * meta.total_episodes
    digests: list[str | None] = []
    for index in range(meta.total_episodes):
        rows = read_rows(meta, index)
        total = hashlib.blake2b(digest_size=DIGEST_BYTES)
        for key in keys:
            total.update(np.ascontiguousarray(values_of(rows, key, meta.features[key])).tobytes())
        digests.append(total.hexdigest())
    return digests


def picture_digests(meta: LeRobotDatasetMetadata) -> list[str]:
    """Per episode a digest of the statistics of its pictures, which LeRobot's tools carry along."""
    digests = []
    for row in _statistics(meta):
        total = hashlib.blake2b(digest_size=DIGEST_BYTES)
        for name in sorted(row):
            total.update(np.asarray(_flat(row[name]), np.float64).tobytes())
        digests.append(total.hexdigest())
    return digests


def _statistics(meta: LeRobotDatasetMetadata) -> Iterator[dict[str, Any]]:
    wanted = {f"stats/{key}/{name}" for key in meta.camera_keys for name in STATISTICS}
    for path in sorted((meta.root / "meta" / "episodes").glob("*/*.parquet")):
        with pq.ParquetFile(path) as file:
            yield from file.read(sorted(wanted & set(file.schema_arrow.names))).to_pylist()


def _flat(value: Any) -> list[float]:
    if isinstance(value, list):
        return [number for item in value for number in _flat(item)]
    return [float("nan") if value is None else float(value)]
