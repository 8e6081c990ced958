"""Columns of a dataset that say where a camera was in every frame: checked, read, and written for displaced cameras."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from lerobot.datasets import LeRobotDatasetMetadata
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import CameraConfig
from lerobot_msdyn.core.errors import ConfigError, EpisodeError
from lerobot_msdyn.core.fields import AUTO
from lerobot_msdyn.core.geometry import invert_se3
from lerobot_msdyn.dataset.rows import read_columns
from lerobot_msdyn.dataset.select import check_cameras_named

ORIGIN = "column"
WORLD = "the dataset's poses"  # of all such columns: an episode whose poses are not in it is found out by its pictures
SHEARED = 0.01  # by which R^T R of a matrix may be off the identity, as of one that was rounded
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

_MATRICES = {(4, 4): (4, 4), (16,): (4, 4), (3, 4): (3, 4), (12,): (3, 4)}  # shape of a cell -> of its matrix
_ROTATIONS = {  # of a cell of position and rotation: how many numbers, and what reads and writes them
    "quaternion_xyzw": (4, Rotation.from_quat, Rotation.as_quat),
    "quaternion_wxyz": (
        4,
        lambda q: Rotation.from_quat(q, scalar_first=True),
        lambda r: r.as_quat(scalar_first=True),
    ),
    "euler_xyz": (3, lambda a: Rotation.from_euler("xyz", a), lambda r: r.as_euler("xyz")),
    "rotation_vector": (3, Rotation.from_rotvec, Rotation.as_rotvec),
}


@dataclass(frozen=True)
class PoseColumn:
    """A column, and how its cells say a pose."""

    name: str
    shape: tuple[int, ...]  # of a cell
    rotation: str  # matrix, or one of _ROTATIONS
    maps: str  # c2w or w2c
    axes: str  # opencv or opengl

    def poses(self, cells: Float[ndarray, "t *cell"]) -> Float64[ndarray, "t 4 4"]:
        """World from camera (OpenCV axes, m) of some cells.

        Raises:
            ValueError: one is no rigid motion.
        """
        count = len(cells)
        poses = np.tile(np.eye(4), (count, 1, 1))
        if self.rotation == "matrix":
            rows, columns = _MATRICES[self.shape]
            poses[:, :rows] = cells.astype(np.float64).reshape(count, rows, columns)
            R = poses[:, :3, :3]
            off = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max((1, 2))
            wrong = (off > SHEARED) | (np.linalg.det(R) < 0) | (np.abs(poses[:, 3] - np.eye(4)[3]).max(1) > SHEARED)
            if wrong.any():
                raise ValueError(f"the matrix of frame {int(np.argmax(wrong))} is no rotation with a shift")
            poses[:, :3, :3] = Rotation.from_matrix(R).as_matrix()
        else:
            _, read, _ = _ROTATIONS[self.rotation]
            values = cells.astype(np.float64).reshape(count, -1)
            if self.rotation.startswith("quaternion"):
                length = np.linalg.norm(values[:, 3:], axis=1)
                if (np.abs(length - 1) > SHEARED).any():
                    frame = int(np.argmax(np.abs(length - 1)))
                    raise ValueError(f"the quaternion of frame {frame} has length {length[frame]:.3g}")
            poses[:, :3, 3], poses[:, :3, :3] = values[:, :3], read(values[:, 3:]).as_matrix()
        poses = _inverse(poses) if self.maps == "w2c" else poses
        return poses @ OPENGL if self.axes == "opengl" else poses

    def cells(self, poses: Float64[ndarray, "t 4 4"], like: Float[ndarray, "t *cell"]) -> Float[ndarray, "t *cell"]:
        """Cells that say these poses, which are not far from those of `like`, in its type."""
        count = len(poses)
        poses = poses @ OPENGL if self.axes == "opengl" else poses
        poses = _inverse(poses) if self.maps == "w2c" else poses
        if self.rotation == "matrix":
            rows, columns = _MATRICES[self.shape]
            return poses[:, :rows, :columns].reshape(count, *self.shape).astype(like.dtype)
        _, _, write = _ROTATIONS[self.rotation]
        turned = write(Rotation.from_matrix(poses[:, :3, :3]))
        if self.rotation.startswith("quaternion"):  # of the two that say the same, the one that the column would have
            turned *= np.where((turned * like.reshape(count, -1)[:, 3:]).sum(1, keepdims=True) < 0, -1.0, 1.0)
        return np.concatenate([poses[:, :3, 3], turned], 1).reshape(count, *self.shape).astype(like.dtype)


def _inverse(poses: Float64[ndarray, "t 4 4"]) -> Float64[ndarray, "t 4 4"]:
    return invert_se3(torch.from_numpy(poses)).numpy()


def pose_column(meta: LeRobotDatasetMetadata, key: str, config: CameraConfig) -> PoseColumn | None:
    """The column of a camera's poses; None where the settings name none.

    Raises:
        ConfigError: the dataset has no such column, or one that does not say poses.
    """
    name = config.pose_column(key)
    return None if name is None else _column(meta, name, config)


def check_pose_columns(meta: LeRobotDatasetMetadata, config: CameraConfig) -> None:
    """Whether the dataset has what `camera.pose_columns` names.

    Raises:
        ConfigError: it has not.
    """
    check_cameras_named(meta, config.pose_columns)
    for name in config.pose_columns.values():
        _column(meta, name, config)


def posed_by_column(
    meta: LeRobotDatasetMetadata, key: str, index: int, config: CameraConfig, cells_of: Callable[[str], ndarray]
) -> Float[Tensor, "t 4 4"] | None:
    """World from camera in every frame of an episode, by the camera's column; None where there is none.

    `cells_of` gives a column's values [t, ...].

    Raises:
        ConfigError: the dataset has no such column, or one that does not say poses.
        EpisodeError: a cell is no rigid motion.
    """
    column = pose_column(meta, key, config)
    if column is None:
        return None
    try:
        return torch.from_numpy(column.poses(cells_of(column.name))).float()
    except ValueError as error:
        raise EpisodeError(
            f"{meta.repo_id} episode {index}: {column.name}: {error}; it was read as {column.rotation} "
            "(--camera.pose_rotation)"
        ) from error


def new_poses(
    meta: LeRobotDatasetMetadata, index: int, config: CameraConfig, cameras: Mapping[str, CameraTrack]
) -> dict[str, ndarray]:
    """The columns [t, ...] of poses that are others where a recording's cameras stand elsewhere.

    Args:
        meta: the dataset.
        index: the episode.
        config: says which columns.
        cameras: the new ones whose recorded one's poses are a column's, by feature key.

    Raises:
        ConfigError: the settings do not say which column.
        EpisodeError: the recorded values cannot be read.
    """
    columns = {}
    for key in cameras:
        column = pose_column(meta, key, config)
        if column is None:
            raise ConfigError(
                f"{meta.repo_id}: the poses of {key} in the kept scenes are a column's, which has to say where the new "
                f"camera stands; name it: --camera.pose_columns '{{{key}: COLUMN}}'"
            )
        columns[key] = column
    recorded = read_columns(meta, index, [column.name for column in columns.values()]) if columns else {}
    return {
        column.name: column.cells(cameras[key].world_from_camera.double().numpy(), recorded[column.name])
        for key, column in columns.items()
    }


def _column(meta: LeRobotDatasetMetadata, name: str, config: CameraConfig) -> PoseColumn:
    feature = meta.features.get(name)
    if feature is None or not feature["dtype"].startswith("float"):
        numeric = sorted(key for key, other in meta.features.items() if other["dtype"].startswith("float"))
        raise ConfigError(
            f"camera.pose_columns names {name!r}; expected one of {meta.repo_id}'s columns of floating-point numbers: "
            f"{', '.join(numeric)}"
        )
    shape = tuple(int(side) for side in feature["shape"])
    rotation = config.pose_rotation
    told = _told(shape, feature) if rotation == AUTO else rotation
    if told is None or not _fits(told, shape):
        asked = "" if rotation == AUTO else f" as {rotation}"
        raise ConfigError(
            f"{meta.repo_id}: {name} of shape {list(shape)} with the names {feature['names']} cannot be read as poses"
            f"{asked}; expected a matrix (4x4 or 3x4), a position with a quaternion (7 numbers), or one with angles (6 "
            "numbers; --camera.pose_rotation euler_xyz or rotation_vector)"
        )
    return PoseColumn(name, shape, told, config.pose_maps, config.pose_axes)


def _fits(rotation: str, shape: tuple[int, ...]) -> bool:
    return shape in _MATRICES if rotation == "matrix" else shape == (3 + _ROTATIONS[rotation][0],)


def _told(shape: tuple[int, ...], feature: dict[str, Any]) -> str | None:
    """How a column says a rotation, by its shape and its names; None if they do not tell."""
    if shape in _MATRICES:
        return "matrix"
    names = [str(name).lower().rsplit(".", 1)[-1].rsplit("_", 1)[-1] for name in _flat(feature.get("names"))]
    if shape == (7,):
        return "quaternion_wxyz" if len(names) == 7 and names[3] in ("qw", "w") else "quaternion_xyzw"
    if shape == (6,) and len(names) == 6:
        if names[3:] == ["roll", "pitch", "yaw"]:
            return "euler_xyz"
        if names[3:] == ["rx", "ry", "rz"]:
            return "rotation_vector"
    return None


def _flat(names: Any) -> list[Any]:
    """Names of a feature, which LeRobot's users also give as {group: [names]}."""
    if isinstance(names, dict):
        return [one for group in names.values() for one in _flat(group)]
    return list(names) if isinstance(names, list | tuple) else []
