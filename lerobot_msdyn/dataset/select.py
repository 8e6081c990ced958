"""Which episodes and cameras of a dataset are worked on: those asked for, or all that may be re-rendered."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol, runtime_checkable

from lerobot_msdyn.core.errors import ConfigError, DatasetError
from lerobot_msdyn.dataset.checks import read_json

# Words in names of cameras: wrist, left_wrist, handcam, eye_in_hand, gripper2; but not handover or toolbox.
ON_ROBOT = re.compile(
    r"(?<![a-z])(left|right|l|r)?(wrist|hand|gripper|palm|finger|effector|flange|tool)s?(cam|camera|eye|view)?(?![a-z])"
)


@runtime_checkable
class Listing(Protocol):
    """What is chosen from: LeRobot's metadata of a dataset, or `metadata.Metadata`, which needs no LeRobot."""

    @property
    def repo_id(self) -> str: ...
    @property
    def root(self) -> Path: ...
    @property
    def total_episodes(self) -> int: ...
    @property
    def camera_keys(self) -> list[str]: ...
    @property
    def depth_keys(self) -> list[str]: ...


def select_episodes(meta: Listing, episodes: list[int] | None) -> list[int]:
    """The episodes asked for, each once and in order; all of them if none are named.

    Raises:
        DatasetError: an index is out of range, or of an episode that is lost.
    """
    if episodes is None:
        return list(range(meta.total_episodes))
    bad = [index for index in episodes if not 0 <= index < meta.total_episodes]
    lost = lost_episodes(meta)
    if any(index in lost for index in bad):
        raise DatasetError(
            f"{meta.repo_id}: episode {', '.join(map(str, bad))} is lost: meta/info.json lists {lost.stop} episodes, "
            f"but only 0 to {lost.start - 1} are there; choose among these"
        )
    if bad:
        raise DatasetError(
            f"{meta.repo_id}: no episode {', '.join(map(str, bad))}; "
            f"it has {meta.total_episodes} (0 to {meta.total_episodes - 1})"
        )
    return sorted(set(episodes))


def lost_episodes(meta: Listing) -> range:
    """Episodes that info.json lists and a killed recorder has not finished (`open_source` has warned of them)."""
    return range(meta.total_episodes, read_json(meta.root, "meta/info.json")["total_episodes"])


def colour_cameras(meta: Listing) -> list[str]:
    """Feature keys of the colour cameras."""
    return [key for key in meta.camera_keys if key not in meta.depth_keys]


def select_cameras(meta: Listing, cameras: list[str] | None, *, allow_moving: bool = False) -> list[str]:
    """The cameras to re-render: those asked for (by key or its last part), else all that are not on the robot.

    Raises:
        DatasetError: a name is unknown or of a camera on the robot, or no camera is left.
    """
    colour = colour_cameras(meta)
    if cameras is None:
        chosen = [key for key in colour if allow_moving or not is_wrist_camera(key)]
        if not chosen:
            raise DatasetError(
                f"{meta.repo_id}: no camera to re-render; its colour cameras are {', '.join(colour) or 'none'}"
            )
        return chosen
    chosen = []
    for name in cameras:
        matches = [key for key in colour if name in (key, key.rsplit(".", 1)[-1])]
        if not matches:
            raise DatasetError(f"{meta.repo_id}: no colour camera {name!r}; it has {', '.join(colour) or 'none'}")
        chosen += [key for key in matches if key not in chosen]
    on_robot = [key for key in chosen if is_wrist_camera(key)]
    if on_robot and not allow_moving:
        raise DatasetError(
            f"{meta.repo_id}: {', '.join(on_robot)} moves with the robot, by its name: its picture is tied to the "
            "state, and would belong to another one; leave it out"
        )
    return chosen


def check_cameras_named(meta: Listing, names: Iterable[str]) -> None:
    """Whether the dataset has the cameras that `camera.pose_columns` names, by key or its last part.

    Raises:
        ConfigError: it has not.
    """
    keys = colour_cameras(meta)
    known = {*keys, *(key.rsplit(".", 1)[-1] for key in keys)}
    for name in names:
        if name not in known:
            raise ConfigError(
                f"camera.pose_columns names the camera {name!r}; {meta.repo_id} has {', '.join(keys) or 'none'}"
            )


def is_wrist_camera(key: str) -> bool:
    """Whether a camera's name says that it moves with the robot."""
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", key.rsplit(".", 1)[-1])  # wristCamera
    return ON_ROBOT.search(name.lower()) is not None
