"""What made each episode of an output dataset, kept in its meta/msdyn/."""

import importlib.metadata
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.cameras import CameraTrack
from lerobot_msdyn.errors import OutputError

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
    views: dict[str, dict[str, Any]] = field(default_factory=dict)  # camera -> its `camera_pose`
    gate: dict[str, Any] = field(default_factory=dict)  # scores and what was rejected, see docs/quality.md


def camera_pose(source: CameraTrack, new: CameraTrack) -> dict[str, Any]:
    """A new camera for the record: K (px), and camera_from_source, which maps the recorded camera's axes to its (m).

    One 3x3 and one 4x4 matrix where they are the same at every frame, else one per frame; rounded to 1e-6.
    """
    change = new.camera_from_world.double() @ source.world_from_camera.double()
    return {"K": _once(new.intrinsics), "camera_from_source": _once(change)}


def _once(matrices: Float[Tensor, "t n n"]) -> list[Any]:
    rounded = (matrices.double() * 1e6).round() / 1e6
    return list((rounded[0] if bool((rounded == rounded[:1]).all()) else rounded).tolist())


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
        found = [entry[name] for entry in entries if name in entry]
        keys = dict.fromkeys(key for some in found for key in some)
        together[name] = {key: "; ".join(dict.fromkeys(some[key] for some in found if key in some)) for key in keys}
    return together


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
