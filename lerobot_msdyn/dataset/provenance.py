"""The record of an output dataset, meta/msdyn/: from which recording each episode comes, and what made it.

`lineage` finds out the same of any dataset, also where this record was lost.
"""

import hashlib
import importlib.metadata
import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import DatasetError, OutputError
from lerobot_msdyn.core.files import write_whole

FOLDER = Path("meta") / "msdyn"
TABLE = FOLDER / "episodes.parquet"
RECIPE = FOLDER / "recipe.yaml"
PREVIEW = FOLDER / "preview.jpg"  # recorded and new moments of one view, for the card
CALIBRATION = "calibration"  # in FOLDER: what the robot's joints say of the cameras
CHECKED = ("episode_index", "source_repo_id", "source_episode")  # columns that every record has
AT_ONCE = 1000  # rows that are plain values before they are a table, which takes a tenth of the memory
SOURCE_VARIANT = -1  # the variant of an episode that was copied, not rendered
SAME = 3e-6  # m, px, or of a matrix: poses are kept in single precision, and what differs by less is the same


@dataclass(frozen=True)
class Provenance:
    """Where one episode of the output came from and how it was made."""

    source_repo_id: str
    source_episode: int
    variant: int  # SOURCE_VARIANT for a copy of the source's episode
    seed: int
    perturbation: dict[str, dict[str, float]] = field(default_factory=dict)  # camera -> what was sampled
    priors: dict[str, dict[str, dict[str, str]]] = field(
        default_factory=dict
    )  # camera -> prior -> provider, why, model
    views: dict[str, dict[str, Any]] = field(default_factory=dict)  # camera -> its `camera_pose`
    gate: dict[str, Any] = field(default_factory=dict)  # scores and what was rejected, see docs/views.md
    times_replaced_s: float = 0.0  # how far recorded times were off frame_index / fps, which replaced them; 0: kept


def camera_pose(source: CameraTrack, new: CameraTrack) -> dict[str, Any]:
    """A new camera for the record: K (px), and camera_from_source, which maps the recorded camera's axes to its (m).

    Where the recorded camera stands still and its pose in a world is known, `world_from_camera` is the new one's there.
    One 3x3 and one 4x4 matrix where they are the same at every frame, else one per frame; rounded to 1e-6.
    """
    change = new.camera_from_world.double() @ source.world_from_camera.double()
    pose = {"K": _once(new.intrinsics), "camera_from_source": _once(change)}
    placed = source.world and source.is_static
    return pose | ({"world_from_camera": _once(new.world_from_camera)} if placed else {})


def _once(matrices: Float[Tensor, "t n n"]) -> list[Any]:
    rounded = (matrices.double() * 1e6).round() / 1e6
    same = bool(((matrices - matrices[:1]).abs() <= SAME).all())
    return list((rounded[0] if same else rounded).tolist())


def write_unseen(root: Path, index: int, masks: Mapping[str, np.ndarray]) -> None:
    """Write meta/msdyn/unseen/episode_000012.npz: the arrays of `UnseenMasks`."""
    path = root / FOLDER / "unseen" / f"episode_{index:06d}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = dict(masks)
    np.savez_compressed(path, **arrays)


def read_unseen(path: Path, camera: str) -> Bool[np.ndarray, "t h w"]:
    """One camera's masks of a file that `write_unseen` wrote: True where nothing was ever seen.

    Raises:
        OutputError: it is not such a file, or does not have the camera.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return np.unpackbits(file[camera], axis=-1, count=int(file[f"{camera}.width"])).astype(bool)
    except (OSError, ValueError, KeyError) as error:
        raise OutputError(f"{path}: no masks of {camera!r} there ({error}); they are kept with --masks") from error


def merged(entries: Sequence[dict[str, dict[str, str]]]) -> dict[str, dict[str, str]]:
    """What is known about the priors of a video's windows, as one: where they differ, all that was said, in order."""
    names = dict.fromkeys(name for entry in entries for name in entry)
    together: dict[str, dict[str, str]] = {}
    for name in names:
        of_windows = [entry[name] for entry in entries if name in entry]
        keys = dict.fromkeys(key for window in of_windows for key in window)
        together[name] = {
            key: "; ".join(dict.fromkeys(window[key] for window in of_windows if key in window)) for key in keys
        }
    return together


def write_provenance(root: Path, episodes: Iterable[Provenance], recipe_yaml: str, run: str = "") -> None:
    """Write meta/msdyn/episodes.parquet (one row per episode) and the recipe that was used.

    `run` is the digest of all that the result depends on, by which the same command knows its output again.
    """
    common = {
        "run": run,
        "recipe_sha256": hashlib.sha256(recipe_yaml.encode()).hexdigest(),
        "version": importlib.metadata.version("lerobot_msdyn"),
        "lerobot_version": importlib.metadata.version("lerobot"),
    }

    def row(episode: Provenance) -> dict[str, Any]:
        own = {item.name: getattr(episode, item.name) for item in fields(episode)}
        texts = {key: json.dumps(value) if isinstance(value, dict) else value for key, value in own.items()}
        return texts | {"licences": json.dumps(licences(episode.priors))} | common

    write_rows(root, map(row, episodes))
    write_whole(root / RECIPE, recipe_yaml.encode())


def write_rows(root: Path, rows: Iterable[dict[str, Any]]) -> None:
    """Write meta/msdyn/episodes.parquet; the row of an episode is that of its number."""
    numbered = ({"episode_index": i} | row for i, row in enumerate(rows))
    parts = [_compressed(pa.Table.from_pylist(list(part))) for part in itertools.batched(numbered, AT_ONCE)]
    schemas = [pq.read_schema(part) for part in parts] or [pa.schema([])]
    schema = pa.unify_schemas(schemas, promote_options="permissive")
    whole = pa.BufferOutputStream()
    with pq.ParquetWriter(whole, schema) as writer:
        for part in parts:
            tables = [schema.empty_table(), pq.read_table(part)]
            writer.write_table(pa.concat_tables(tables, promote_options="permissive"))
    write_whole(root / TABLE, whole.getvalue().to_pybytes())


def _compressed(table: pa.Table) -> pa.Buffer:
    """As a parquet file in memory, a fifth of the size."""
    buffer = pa.BufferOutputStream()
    pq.write_table(table, buffer)
    return buffer.getvalue()


def read_column(root: Path, name: str) -> Iterator[Any]:
    """One column of meta/msdyn/episodes.parquet, or None for each row where it has none.

    It is read in parts, since scores of thousands of views take much memory.
    """
    with pq.ParquetFile(root / TABLE) as file:
        if name not in file.schema_arrow.names:
            yield from itertools.repeat(None, file.metadata.num_rows)
            return
        for batch in file.iter_batches(AT_ONCE, columns=[name]):
            yield from batch[name].to_pylist()


def read_provenance(root: Path, columns: Sequence[str] | None = None) -> list[dict[str, Any]] | None:
    """The rows of meta/msdyn/episodes.parquet in the order of the episodes; None if there is no such file.

    `columns` names those to read, if not all; the ones that are checked are always among them.

    Raises:
        DatasetError: it is damaged, or not one row per episode.
    """
    path = root / TABLE
    if not path.is_file():
        return None
    try:
        names = pq.read_schema(path).names
        wanted = names if columns is None else [name for name in names if name in (*CHECKED, *columns)]
        rows: list[dict[str, Any]] = pq.read_table(path, columns=wanted).to_pylist()
        rows = sorted(rows, key=lambda row: row["episode_index"])
        complete = [(row["episode_index"], bool(row["source_repo_id"]), row["source_episode"] >= 0) for row in rows]
    except (OSError, KeyError, TypeError, pa.ArrowException) as error:
        raise DatasetError(f"{path} cannot be read ({type(error).__name__})") from error
    if complete != [(i, True, True) for i in range(len(rows))]:
        raise DatasetError(f"{path}: expected one row for each of episodes 0 to {len(rows) - 1}, with its source")
    return rows


def licences(priors: dict[str, dict[str, dict[str, str]]]) -> dict[str, str]:
    """Licence by learned model, of all models that took part."""
    used = [prior for camera in priors.values() for prior in camera.values() if "model" in prior]
    return {prior["model"]: prior.get("licence", "unknown") for prior in used}
