"""What made each episode of an output dataset, kept in its meta/msdyn/."""

import hashlib
import importlib.metadata
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_msdyn.errors import DatasetError
from lerobot_msdyn.files import write_whole

FOLDER = Path("meta") / "msdyn"
TABLE = FOLDER / "episodes.parquet"
RECIPE = FOLDER / "recipe.yaml"
SOURCE_VARIANT = -1  # the variant of an episode that was copied, not rendered


@dataclass(frozen=True)
class Provenance:
    """Where one episode of the output came from and how it was made."""

    source_repo_id: str
    source_episode: int
    variant: int  # SOURCE_VARIANT for a copy of the source's episode
    seed: int
    perturbation: dict[str, dict[str, float]] = field(default_factory=dict)  # camera -> what was drawn
    priors: dict[str, dict[str, dict[str, str]]] = field(
        default_factory=dict
    )  # camera -> prior -> provider, why, model


def write_provenance(root: Path, episodes: Sequence[Provenance], recipe_yaml: str) -> None:
    """Write meta/msdyn/episodes.parquet (one row per episode) and the recipe that was used."""
    common = {
        "recipe_sha256": hashlib.sha256(recipe_yaml.encode()).hexdigest(),
        "version": importlib.metadata.version("lerobot_msdyn"),
        "lerobot_version": importlib.metadata.version("lerobot"),
    }
    rows = []
    for episode in episodes:
        row = {key: json.dumps(value) if isinstance(value, dict) else value for key, value in asdict(episode).items()}
        rows.append(row | {"licences": json.dumps(licences(episode.priors))} | common)
    write_rows(root, rows)
    write_whole(root / RECIPE, recipe_yaml.encode())


def write_rows(root: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write meta/msdyn/episodes.parquet; the row of an episode is that of its number."""
    buffer = pa.BufferOutputStream()
    pq.write_table(pa.Table.from_pylist([{"episode_index": i} | row for i, row in enumerate(rows)]), buffer)
    write_whole(root / TABLE, buffer.getvalue().to_pybytes())


def read_provenance(root: Path) -> list[dict[str, Any]] | None:
    """The rows of meta/msdyn/episodes.parquet in the order of the episodes; None if there is no such file.

    Raises:
        DatasetError: it is damaged, or not one row per episode.
    """
    path = root / TABLE
    if not path.is_file():
        return None
    try:
        rows: list[dict[str, Any]] = pq.read_table(path).to_pylist()
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
