"""Whether there is what a command line names, as far as that is told without LeRobot and torch, which take long."""

import importlib.util
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_msdyn.augment.asked import check_robot
from lerobot_msdyn.core.errors import ConfigError, DatasetError, first_line
from lerobot_msdyn.core.files import check_root
from lerobot_msdyn.dataset.metadata import described
from lerobot_msdyn.dataset.select import Listing, colour_cameras, select_cameras, select_episodes
from lerobot_msdyn.evaluate.config import DycheckConfig, EvaluateConfig, HeldoutCameraConfig
from lerobot_msdyn.evaluate.dycheck.splits import read_split
from lerobot_msdyn.priors.files import check_files

ALEXNET_FILE = "the state of lpips.LPIPS(net='alex').net, or torchvision's checkpoint of AlexNet"


def check_nvs(config: EvaluateConfig) -> None:
    """For `evaluate nvs`.

    Raises:
        MsdynError: something is not there, or cannot be read.
    """
    recorded_camera(config)
    repo_id, root = recorded_dataset(config)
    check_root(root)
    meta = described(repo_id, root)
    if meta is not None:
        check_robot(meta, select_cameras(meta, config.cameras)[:1], config)
    check_files(config.camera, replace(config.priors, depth=config.depth_provider))
    check_weights(config.lpips_weights)


def check_dycheck(config: DycheckConfig) -> None:
    """The same for `evaluate dycheck`."""
    for name in ("train", "val"):
        read_split(config.root, name)
    check_files(replace(config.camera, calibration=None), config.priors)  # the sequence has its own
    check_weights(config.lpips_weights)


def check_heldout(config: HeldoutCameraConfig) -> None:
    """The same for `evaluate heldout-camera`."""
    meta = described(config.repo_id, config.root)
    if meta is not None:
        chosen_cameras(meta, config)
    check_files(config.camera, config.priors)
    check_weights(config.lpips_weights)


def check_weights(path: Path | None) -> None:
    """Whether there is the file that `lpips_weights` names, where LPIPS is installed.

    Raises:
        ConfigError: it cannot be opened.
    """
    if path is not None and importlib.util.find_spec("lpips") is not None:
        try:
            path.open("rb").close()
        except OSError as error:
            raise unreadable_weights(path, error) from error


def unreadable_weights(path: Path, error: Exception) -> ConfigError:
    """What to say of weights that cannot be read."""
    return ConfigError(f"lpips_weights: {path} cannot be read ({first_line(error)}); expected {ALEXNET_FILE}")


def recorded_dataset(config: EvaluateConfig) -> tuple[str, Path]:
    """Name and folder of the dataset that is fitted."""
    folder = config.scene_folder
    return f"local/{folder.name}", folder / ("dataset_depth" if config.depth == "recorded" else "dataset")


def recorded_camera(config: EvaluateConfig) -> dict[str, Any]:
    """The true camera of that dataset's video.

    Raises:
        DatasetError: the file cannot be read.
    """
    return read_arrays(config.scene_folder / "gt" / "train.npz", ("K", "c2w"))


def read_arrays(path: Path, names: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, Any]:
    """Some arrays of an npz file; the others are not read.

    Raises:
        DatasetError: it cannot be read, or lacks one of them.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in names + tuple(name for name in optional if name in file)}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise DatasetError(
            f"{path}: expected an npz file with {', '.join(names)} ({error}); see docs/evaluate.md"
        ) from error


def chosen_cameras(meta: Listing, config: HeldoutCameraConfig) -> tuple[str, str, list[str]]:
    """Keys of the fitted camera, of the held-out one, and of those that help to measure depth.

    Raises:
        ConfigError: the first two are the same.
        DatasetError: there is no such episode or camera.
    """
    select_episodes(meta, [config.episode])
    train, test = (
        select_cameras(meta, [name], allow_moving=config.allow_moving)[0]
        for name in (config.train_camera, config.test_camera)
    )
    if train == test:
        raise ConfigError(f"--train-camera and --test-camera are both {train}; expected two cameras")
    wanted = select_cameras(meta, config.cameras) if config.cameras is not None else colour_cameras(meta)
    return train, test, [key for key in wanted if key not in (train, test)]
