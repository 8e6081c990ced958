"""What the result of a run depends on: an unfinished run goes on only under the same settings, files and code.

It is compared when a run starts (`Staging.agree`) and stays in the work folder; nothing of it gets into the output.
"""

import dataclasses
import hashlib
import importlib.metadata
import platform
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import draccus
import yaml
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.augment.earlier_scenes import digests_of_scenes
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.fields import PARAMETER
from lerobot_msdyn.core.files import DIGEST_BYTES, digest_of_file
from lerobot_msdyn.core.plugins import plugin_digests
from lerobot_msdyn.core.registry import extending_packages
from lerobot_msdyn.dataset.checks import place_problem
from lerobot_msdyn.dataset.rows import data_files
from lerobot_msdyn.priors.onnx_file import NETWORK_SUFFIX, SPEC_SUFFIX
from lerobot_msdyn.render.devices import chosen_device

LIBRARIES = ("lerobot_msdyn", "lerobot", "torch", "numpy", "opencv-python-headless", "av", "numba", "pyarrow")
PLACES = ("root", "new_root", "dry_run", "restart", "verbose", "workers")  # settings that do not change what is made


def describe_run(root: Path, files: Iterable[Path], config: AugmentConfig) -> dict[str, Any]:
    """Settings, digests of all files that are read and of the plugins, the device and versions, as JSON.

    Args:
        root: the folder of the source.
        files: those of its files that are read.
        config: the settings.

    Raises:
        ConfigError: they demand a device that cannot be used.
    """
    settings = {key: value for key, value in draccus.encode(config).items() if key not in PLACES}
    settings["priors"].pop("cache")
    return {
        "recipe": settings,
        "device": chosen_device(config.device).type,
        "source": {str(path.relative_to(root)): digest_of_file(path) for path in files},
        "scenes": {} if config.scenes is None else digests_of_scenes(config.scenes),
        "files": {str(path): digest_of_file(path) for path in _named_files(settings)},
        "plugins": plugin_digests(),
        "versions": versions() | extending_packages() | {"code": code_digest()},
    }


def source_folder(config: AugmentConfig) -> Path:
    """Where the user's dataset is, unless it comes from the hub."""
    return config.root or Path(HF_LEROBOT_HOME) / config.repo_id


def all_files(root: Path) -> list[Path]:
    """All files of a folder."""
    return sorted(path for path in root.rglob("*") if not path.is_dir())


def source_files(source: LeRobotDatasetMetadata, episodes: Iterable[int]) -> list[Path]:
    """The metadata of a dataset and the files that some of its episodes lie in."""
    files = {path for path in all_files(source.root / "meta") if "msdyn" not in path.parts}
    for index in episodes:
        if place_problem(source.episodes[index], source.video_keys) is None:
            files.update(source.root / path for path in data_files(source, index))
            files.update(source.root / source.get_video_file_path(index, key) for key in source.video_keys)
    return sorted(files)


def versions() -> dict[str, str]:
    """The versions of this package, of Python, and of the libraries that decide on pixels and files."""
    return {name: importlib.metadata.version(name) for name in LIBRARIES} | {"python": platform.python_version()}


def code_digest() -> str:
    """Changes whenever a module of this package does."""
    total = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        total.update(path.read_bytes())
    return total.hexdigest()


def recipe_text(config: Recipe) -> str:
    """The settings as a recipe file, without the user's folders: of files outside, the names are kept."""
    fields = {item.name for item in dataclasses.fields(Recipe)}
    settings = {key: value for key, value in draccus.encode(config).items() if key in fields}
    settings["priors"].pop("cache")
    return yaml.safe_dump(_without_folders(settings))


def _without_folders(settings: Any) -> Any:
    """Settings with the names alone of files that are given by absolute paths."""
    if isinstance(settings, dict):
        return {key: _without_folders(value) for key, value in settings.items()}
    if isinstance(settings, list):
        return [_without_folders(value) for value in settings]
    if not isinstance(settings, str):
        return settings
    name, colon, parameter = settings.rpartition(PARAMETER)
    return f"{name}{colon}{Path(parameter).name}" if Path(parameter).is_absolute() else settings


def _named_files(settings: Any) -> list[Path]:
    """The files that settings name: calibrations, exchange files, weights, networks, and their YAML beside them."""
    if isinstance(settings, dict):
        return [path for value in settings.values() for path in _named_files(value)]
    if not isinstance(settings, str):
        return []
    parameter = settings.partition(PARAMETER)[2]
    named = [Path(text) for text in (settings, parameter) if text]
    beside = [path.with_suffix(SPEC_SUFFIX) for path in named if path.suffix == NETWORK_SUFFIX]
    patterns = f"*{NETWORK_SUFFIX}", f"*{SPEC_SUFFIX}"
    inside = [path for folder in named[1:] for pattern in patterns for path in sorted(folder.glob(pattern))]
    return [path for path in [*named, *beside, *inside] if path.suffix != "" and path.is_file()]
