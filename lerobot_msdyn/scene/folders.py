"""Where kept scenes lie (docs/scene.md). Without torch."""

from pathlib import Path

from lerobot_msdyn.core.errors import MsdynError

FOLDER = Path("msdyn_scenes")  # inside an output dataset
HEADER = "scene.json"  # of the scene of one camera


def scenes_root(folder: Path) -> Path:
    """The folder of scenes of an output dataset, or the folder itself where it is one.

    Raises:
        MsdynError: there are none.
    """
    for root in (folder / FOLDER, folder):
        if next(root.glob(f"episode_*/*/{HEADER}"), None) is not None:
            return root
    raise MsdynError(
        f"no saved scenes in {folder}: expected {FOLDER}/episode_000000/<camera>/{HEADER}; "
        "they are kept by `python -m lerobot_msdyn.augment ... --save_scenes true`"
    )


def list_scenes(folder: Path) -> dict[int, dict[str, Path]]:
    """Source episode -> camera -> the folder of its scene; `folder` is an output dataset or its folder of scenes.

    Raises:
        MsdynError: there are none.
    """
    folders: dict[int, dict[str, Path]] = {}
    for header in sorted(scenes_root(folder).glob(f"episode_*/*/{HEADER}")):
        episode = int(header.parent.parent.name.removeprefix("episode_"))
        folders.setdefault(episode, {})[header.parent.name] = header.parent
    return folders
