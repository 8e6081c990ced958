"""What made each episode of an output dataset, kept in its meta/msdyn/."""

import importlib.metadata
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

FOLDER = Path("meta") / "msdyn"
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
    gate: dict[str, Any] = field(default_factory=dict)  # "scores", "rejected", "seconds", see docs/quality.md


def write_provenance(root: Path, episodes: list[Provenance], recipe_yaml: str) -> None:
    """Write meta/msdyn/episodes.parquet (one row per episode) and the recipe that was used."""
    folder = root / FOLDER
    folder.mkdir(parents=True)
    version = importlib.metadata.version("lerobot_msdyn")
    rows = []
    for index, episode in enumerate(episodes):
        row = {key: json.dumps(value) if isinstance(value, dict) else value for key, value in asdict(episode).items()}
        rows.append({"episode_index": index} | row | {"version": version})
    pq.write_table(pa.Table.from_pylist(rows), folder / "episodes.parquet")
    (folder / "recipe.yaml").write_text(recipe_yaml, encoding="utf-8")
