"""Which saved scenes belong to which episodes of a dataset."""

import logging
from collections.abc import Mapping
from pathlib import Path

import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.core.cli import parse_config
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.dataset import provenance
from lerobot_msdyn.scene import store as saved
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
        known, sources = scenes, {episode: episode for episode in scenes}
    else:
        known = saved.list_scenes(scenes)
        sources = _source_episodes(meta, scenes)
        if not sources:
            _check_name(meta, scenes, known)
            sources = {episode: episode for episode in known}
        known = _without_dropped(meta, scenes, known)
    found = {episode: known[sources[episode]] for episode in wanted if sources.get(episode) in known}
    for episode, cameras in found.items():
        for camera, scene in cameras.items():
            _check(meta, episode, camera, scene)
    if len(found) < len(wanted):
        logger.warning(
            "%s: %d of %d episodes have no saved scene; their samples stay as recorded",
            meta.repo_id,
            len(wanted) - len(found),
            len(wanted),
        )
    return found


def recipe_of(scenes: Path | Scenes) -> Recipe:
    """The recipe of the run that saved a folder of scenes; the default one for other scenes."""
    if isinstance(scenes, Mapping):
        return Recipe()
    path = _output_of(scenes) / provenance.RECIPE
    if not path.is_file():
        return Recipe()
    return parse_config(AugmentConfig, ["--recipe", str(path)], {}, command="MixedViews")


def _output_of(folder: Path) -> Path:
    """The output dataset that a folder of scenes lies in."""
    root = saved.scenes_root(folder)
    return root.parent if root.name == saved.FOLDER.name else root


def _source_episodes(meta: LeRobotDatasetMetadata, folder: Path) -> dict[int, int]:
    """Episode -> the source's, where the dataset is the output that the scenes lie in."""
    output = _output_of(folder)
    table = output / provenance.FOLDER / "episodes.parquet"
    if output.resolve() != Path(meta.root).resolve() or not table.is_file():
        return {}
    rows = pq.read_table(table, columns=["episode_index", "source_episode"]).to_pylist()
    return {row["episode_index"]: row["source_episode"] for row in rows}


def _check_name(meta: LeRobotDatasetMetadata, scenes: Path, known: Mapping[int, Mapping[str, Path]]) -> None:
    """Whether the scenes are of the dataset by its name: what they show is not compared.

    Raises:
        DatasetError: they are of another one.
    """
    some = next(iter(next(iter(known.values())).values()))
    made_of = saved.read_header(some)["source"]["repo_id"]
    if made_of != meta.repo_id:
        raise DatasetError(
            f"{scenes}: the scenes are of {made_of}; expected {meta.repo_id}, the dataset that is wrapped; if they are "
            "the same, open it by that name, or pass the scenes as a mapping (lerobot_msdyn.scene.store.list_scenes)"
        )


def _without_dropped(
    meta: LeRobotDatasetMetadata, scenes: Path, known: Mapping[int, Mapping[str, Path]]
) -> Mapping[int, Mapping[str, Path]]:
    """The scenes of episodes of which the run kept a new view at least; says once which ones its gate refused."""
    rows = provenance.read_provenance(_output_of(scenes))
    if rows is None:
        return known
    kept = {row["source_episode"] for row in rows if row["variant"] != provenance.SOURCE_VARIANT}
    refused = sorted(set(known) - kept)
    if refused:
        logger.warning("%s: the gate kept no new view of episodes %s; they stay as recorded", meta.repo_id, refused)
    return {episode: cameras for episode, cameras in known.items() if episode in kept}


def _check(meta: LeRobotDatasetMetadata, episode: int, camera: str, scene: Path | SavedScene) -> None:
    """Whether a scene can be of a video of the dataset."""
    if isinstance(scene, SavedScene):
        made_of = (len(scene), scene.camera.height, scene.camera.width)
    else:
        header = saved.read_header(scene)
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
