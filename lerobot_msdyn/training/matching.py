"""Which saved scenes belong to which episodes of a dataset, and how the run that saved them moved the camera."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import draccus
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.core.cli import read_recipe
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import ConfigError, DatasetError, one_line
from lerobot_msdyn.core.fields import problems
from lerobot_msdyn.core.perturbation import Perturbation
from lerobot_msdyn.dataset import provenance
from lerobot_msdyn.scene import store
from lerobot_msdyn.scene.store import SavedScene
from lerobot_msdyn.training.scene_cache import Scenes

logger = logging.getLogger(__name__)


def scenes_of(meta: LeRobotDatasetMetadata, episodes: list[int] | None, scenes: Path | Scenes) -> Scenes:
    """The scenes of a dataset's own episodes, from a folder or a mapping; says once how many episodes have none.

    The dataset may be the one from which the scenes were made, or the output of that run, whose episodes are mapped
    to those that they came from.

    Raises:
        MsdynError: the folder holds no saved scenes.
        DatasetError: the scenes are of other videos.
    """
    wanted = range(meta.total_episodes) if episodes is None else episodes
    if isinstance(scenes, Mapping):
        by_source, sources = scenes, {episode: episode for episode in scenes}
    else:
        by_source = store.list_scenes(scenes)
        sources = _source_episodes(meta, scenes)
        if not sources:
            _check_name(meta, scenes, by_source)
            sources = {episode: episode for episode in by_source}
        by_source = _without_dropped(meta, scenes, by_source)
    matched = {episode: by_source[sources[episode]] for episode in wanted if sources.get(episode) in by_source}
    for episode, cameras in matched.items():
        for camera, scene in cameras.items():
            _check(meta, episode, camera, scene)
    if len(matched) < len(wanted):
        logger.warning(
            "%s: %d of %d episodes have no saved scene; their samples stay as recorded",
            meta.repo_id,
            len(wanted) - len(matched),
            len(wanted),
        )
    return matched


def settings_of(scenes: Path | Scenes, perturbation: Perturbation | None = None) -> tuple[Perturbation, float]:
    """How cameras are moved, and the largest share of a picture that may be empty.

    Both are those of the run that saved a folder of scenes, and the defaults for other scenes. Nothing else of the
    run's recipe is looked at, so that what it needed then (providers, say) need not be there now.

    Args:
        scenes: where they lie, or the scenes.
        perturbation: used instead of the run's, which is then not looked at either.

    Raises:
        ConfigError: the run's perturbation is not known here, or its recipe was changed and is wrong.
    """
    path = None if isinstance(scenes, Mapping) else _output_of(scenes) / provenance.RECIPE
    content = read_recipe(str(path)) if path is not None and path.is_file() else {}
    used = {key: content[key] for key in ("max_unseen", "perturbation") if key in content}
    if perturbation is not None:
        used.pop("perturbation", None)
    _check_is_known(used.get("perturbation", {}), path)
    try:
        recipe = draccus.decode(Recipe, used)
    except (draccus.utils.DraccusException, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(f"{path}: {one_line(error)}") from error
    wrong = problems(recipe)
    if wrong:
        raise ConfigError(f"{path}: " + "; ".join(wrong))
    return perturbation or recipe.perturbation, recipe.max_unseen


def _check_is_known(perturbation: Any, path: Path | None) -> None:
    """Whether the perturbation in a recipe is of a type that is installed here, or was imported before."""
    kind = perturbation.get("type") if isinstance(perturbation, dict) else None
    known = Perturbation.get_known_choices()
    if kind is not None and kind not in known:
        raise ConfigError(
            f"{path}: perturbation.type is {kind!r}, which is not known here; expected one of {', '.join(known)}; "
            "import what registers it first (--plugins FILE.py), or choose another perturbation"
        )


def _output_of(folder: Path) -> Path:
    """The output dataset that a folder of scenes lies in."""
    root = store.scenes_root(folder)
    return root.parent if root.name == store.FOLDER.name else root


def _source_episodes(meta: LeRobotDatasetMetadata, folder: Path) -> dict[int, int]:
    """Episode -> the source's, where the dataset is the output that the scenes lie in."""
    output = _output_of(folder)
    table = output / provenance.FOLDER / "episodes.parquet"
    if output.resolve() != Path(meta.root).resolve() or not table.is_file():
        return {}
    rows = pq.read_table(table, columns=["episode_index", "source_episode"]).to_pylist()
    return {row["episode_index"]: row["source_episode"] for row in rows}


def _check_name(meta: LeRobotDatasetMetadata, scenes: Path, by_source: Mapping[int, Mapping[str, Path]]) -> None:
    """Whether the scenes are of the dataset by its name: what they show is not compared.

    Raises:
        DatasetError: they are of another one.
    """
    first = next(iter(next(iter(by_source.values())).values()))
    made_of = store.read_header(first)["source"]["repo_id"]
    if made_of != meta.repo_id:
        raise DatasetError(
            f"{scenes}: the scenes are of {made_of}; expected {meta.repo_id}, the dataset that is wrapped; if they are "
            "the same, open it by that name, or pass the scenes as a mapping (lerobot_msdyn.scene.store.list_scenes)"
        )


def _without_dropped(
    meta: LeRobotDatasetMetadata, scenes: Path, by_source: Mapping[int, Mapping[str, Path]]
) -> Mapping[int, Mapping[str, Path]]:
    """The scenes of episodes of which the run kept a new view at least; says once which ones its gate refused."""
    rows = provenance.read_provenance(_output_of(scenes))
    if rows is None:
        return by_source
    kept = {row["source_episode"] for row in rows if row["variant"] != provenance.SOURCE_VARIANT}
    refused = sorted(set(by_source) - kept)
    if refused:
        logger.warning("%s: the gate kept no new view of episodes %s; they stay as recorded", meta.repo_id, refused)
    return {episode: cameras for episode, cameras in by_source.items() if episode in kept}


def _check(meta: LeRobotDatasetMetadata, episode: int, camera: str, scene: Path | SavedScene) -> None:
    """Whether a scene can be of a video of the dataset."""
    if isinstance(scene, SavedScene):
        made_of = (len(scene), scene.camera.height, scene.camera.width)
    else:
        header = store.read_header(scene)
        made_of = (header["frames"], header["height"], header["width"])
    if camera not in meta.camera_keys:
        raise DatasetError(f"{meta.repo_id}: it has no camera {camera!r}, which the scenes are of; wrong dataset?")
    height, width = meta.features[camera]["shape"][:2]
    recorded = (int(meta.episodes[episode]["length"]), height, width)
    if made_of != recorded:
        raise DatasetError(
            f"{meta.repo_id} episode {episode}, {camera}: the scene is of {made_of[0]} frames of "
            f"{made_of[2]}x{made_of[1]}; expected {recorded[0]} of {width}x{height}; "
            "the scenes were made from another dataset"
        )
