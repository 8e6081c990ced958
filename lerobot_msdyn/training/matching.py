"""Which saved scenes belong to which episodes of a dataset."""

import logging
from collections.abc import Mapping
from pathlib import Path

import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn import provenance, saved
from lerobot_msdyn.cli import parse_config
from lerobot_msdyn.config import AugmentConfig, PerturbationConfig, Recipe
from lerobot_msdyn.errors import DatasetError
from lerobot_msdyn.saved import SavedScene
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
    if isinstance(scenes, Mapping):
        known, sources = scenes, {episode: episode for episode in scenes}
    else:
        known = saved.list_scenes(scenes)
        sources = _source_episodes(meta, scenes) or {episode: episode for episode in known}
    wanted = range(meta.total_episodes) if episodes is None else episodes
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


def perturbation_of(scenes: Path | Scenes) -> PerturbationConfig:
    """The perturbation of the run that saved a folder of scenes; the default one for other scenes."""
    if isinstance(scenes, Mapping):
        return Recipe().perturbation
    path = _output_of(scenes) / provenance.FOLDER / "recipe.yaml"
    if not path.is_file():
        return Recipe().perturbation
    return parse_config(AugmentConfig, ["--recipe", str(path)], {}, command="MixedViews").perturbation


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
