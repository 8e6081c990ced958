"""The scenes of an earlier run (--scenes), of which new views are rendered without fitting anything."""

from collections.abc import Sequence
from pathlib import Path

from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.dataset.named import output_folder
from lerobot_msdyn.reconstruction.on_disk import fit_digest, load_reconstruction
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.scene.store import camera_folder, list_scenes, read_header, scenes_root


def problems_of_scenes(
    source: LeRobotDatasetMetadata, episodes: Sequence[int], cameras: Sequence[str], folder: Path
) -> dict[int, str]:
    """Why episodes have no scenes there that fit them, by number.

    Raises:
        MsdynError: there are no scenes.
        ConfigError: they are of another dataset.
    """
    there = list_scenes(output_folder(folder))
    problems = {}
    for index in episodes:
        name = f"{source.repo_id} episode {index}"
        for key in cameras:
            if key not in there.get(index, {}):
                problems[index] = f"{name}: {folder} has no scene of {key}; give --episodes and --cameras that it has"
                break
            header = read_header(there[index][key])
            repo_id, frames = header["source"]["repo_id"], int(source.episodes[index]["length"])
            if repo_id != source.repo_id:
                raise ConfigError(
                    f"--scenes {folder} holds scenes of {repo_id}; expected those of {source.repo_id}: name the "
                    "output of a run on this dataset with --save_scenes true"
                )
            if header["frames"] != frames:
                problems[index] = (
                    f"{name}: its scene of {key} in {folder} has {header['frames']} frames; expected {frames}: the "
                    "dataset has changed since; make the scene again"
                )
                break
    return problems


def earlier_scene(folder: Path, episode: int, camera: str) -> Reconstruction:
    """The reconstruction of one camera.

    Raises:
        MsdynError: a file is absent, damaged or of another schema.
    """
    return load_reconstruction(camera_folder(scenes_root(output_folder(folder)), episode, camera))


def digests_of_scenes(folder: Path) -> dict[str, str]:
    """What tells the scenes of one run from those of another."""
    return {
        f"{index}/{key}": fit_digest(place)
        for index, of_cameras in list_scenes(output_folder(folder)).items()
        for key, place in of_cameras.items()
    }
