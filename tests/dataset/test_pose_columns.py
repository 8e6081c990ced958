"""Columns of camera poses: read by their conventions, refused in one line, written for cameras that stand elsewhere."""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from scipy.spatial.transform import Rotation

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.config import CameraConfig
from lerobot_msdyn.core.errors import ConfigError, EpisodeError
from lerobot_msdyn.dataset import pose_columns
from lerobot_msdyn.dataset.pose_columns import check_pose_columns, new_poses, pose_column, posed_by_column

FRONT, COLUMN = "observation.images.front", "observation.camera_pose"
FLIP = np.diag([1.0, -1, -1, 1])


def dataset(shape: list[int], names: Any = None) -> LeRobotDatasetMetadata:
    """The metadata of one with such a column; nothing of it stays on disk."""
    features = {
        FRONT: {"dtype": "video", "shape": (8, 8, 3), "names": ["height", "width", "channels"]},
        COLUMN: {"dtype": "float32", "shape": tuple(shape), "names": names},
        "counts": {"dtype": "int64", "shape": (7,), "names": None},
    }
    with tempfile.TemporaryDirectory() as folder:
        return LeRobotDatasetMetadata.create("local/walk", 10, features, root=Path(folder) / "walk")


def settings(**more: Any) -> CameraConfig:
    return replace(CameraConfig(), pose_columns={"front": COLUMN}, **more)


@pytest.fixture
def poses() -> np.ndarray:
    """World from camera at five moments."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.random(5, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(5, 3))
    return poses


def with_position(poses: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    return np.concatenate([poses[:, :3, 3], rotation], 1)


def quaternions(poses: np.ndarray, *, scalar_first: bool = False) -> np.ndarray:
    return with_position(poses, Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=scalar_first))


CELLS: dict[str, tuple[Any, Any, dict[str, str]]] = {  # how cells come from poses, names, settings
    "4x4": (lambda p: p, None, {}),
    "16": (lambda p: p.reshape(-1, 16), None, {}),
    "3x4": (lambda p: p[:, :3], None, {}),
    "12": (lambda p: p[:, :3].reshape(-1, 12), None, {}),
    "w2c": (np.linalg.inv, None, {"pose_maps": "w2c"}),
    "opengl": (lambda p: p @ FLIP, None, {"pose_axes": "opengl"}),
    "w2c of opengl": (lambda p: np.linalg.inv(p @ FLIP), None, {"pose_maps": "w2c", "pose_axes": "opengl"}),
    "7": (quaternions, None, {}),
    "7, w first by its names": (
        lambda p: quaternions(p, scalar_first=True),
        ["x", "y", "z", "cam_qw", "cam_qx", "cam_qy", "cam_qz"],
        {},
    ),
    "7, w first by the settings": (
        lambda p: quaternions(p, scalar_first=True),
        None,
        {"pose_rotation": "quaternion_wxyz"},
    ),
    "6, Euler angles by names": (
        lambda p: with_position(p, Rotation.from_matrix(p[:, :3, :3]).as_euler("xyz")),
        {"motors": ["x", "y", "z", "roll", "pitch", "yaw"]},
        {},
    ),
    "6, a rotation vector": (
        lambda p: with_position(p, Rotation.from_matrix(p[:, :3, :3]).as_rotvec()),
        None,
        {"pose_rotation": "rotation_vector"},
    ),
}


@pytest.mark.parametrize("kind", CELLS)
def test_poses_are_read_by_their_convention_and_written_by_it(
    kind: str, poses: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    make, names, more = CELLS[kind]
    cells = make(poses).astype(np.float32)
    meta, config = dataset(list(cells.shape[1:]), names), settings(**more)
    check_pose_columns(meta, config)
    found = posed_by_column(meta, FRONT, 0, config, lambda name: {COLUMN: cells}[name])
    assert found is not None
    np.testing.assert_allclose(found.numpy(), poses, atol=1e-5)
    aside = poses.copy()
    aside[:, 0, 3] += 0.1
    monkeypatch.setattr(pose_columns, "read_columns", lambda meta, index, names: {COLUMN: cells})
    track = static_camera(intrinsics_from_fov(8, 8, 60.0), 5, 8, 8)
    new = new_poses(meta, 0, config, {FRONT: replace(track, world_from_camera=torch.from_numpy(aside).float())})
    assert new[COLUMN].dtype == cells.dtype
    np.testing.assert_allclose(new[COLUMN], make(aside), atol=1e-5)


def test_of_two_quaternions_that_say_the_same_the_recorded_one_is_written(poses: np.ndarray) -> None:
    cells = quaternions(poses)
    cells[::2, 3:] *= -1
    column = pose_column(dataset([7]), FRONT, settings())
    assert column is not None
    np.testing.assert_allclose(column.cells(poses, cells), cells, atol=1e-9)


def test_a_camera_that_is_not_named_has_no_column() -> None:
    meta = dataset([4, 4])
    assert pose_column(meta, "observation.images.side", settings()) is None
    assert not settings().known_before("observation.images.side")
    assert settings().known_before(FRONT)
    assert not replace(settings(), poses="sfm").known_before(FRONT)


@pytest.mark.parametrize(
    ("shape", "names", "config", "said"),
    [
        ([4, 4], None, replace(settings(), pose_columns={"side": COLUMN}), "names the camera 'side'"),
        ([4, 4], None, replace(settings(), pose_columns={"front": "pose"}), "expected one of .*observation.camera"),
        ([4, 4], None, replace(settings(), pose_columns={"front": "counts"}), "names 'counts'"),
        ([5], None, settings(), r"of shape \[5\].* expected a matrix"),
        ([6], None, settings(), "pose_rotation euler_xyz or rotation_vector"),
        ([6], list("abcdef"), settings(), "the names .'a', 'b'"),
        ([7], None, settings(pose_rotation="matrix"), "as matrix"),
        ([4, 4], None, settings(pose_rotation="quaternion_xyzw"), "as quaternion_xyzw"),
    ],
)
def test_what_cannot_be_read_is_refused_before_any_work(
    shape: list[int], names: Any, config: CameraConfig, said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        check_pose_columns(dataset(shape, names), config)


def test_a_cell_that_is_no_rigid_motion_names_its_frame(poses: np.ndarray) -> None:
    sheared, stretched, mirrored = poses.copy(), quaternions(poses), poses @ np.diag([-1.0, 1, 1, 1])
    sheared[3, 0, 0] += 0.5
    stretched[2, 3:] = 0
    for cells, said in ((sheared, "frame 3"), (stretched, "frame 2 has length 0"), (mirrored, "frame 0")):
        with pytest.raises(EpisodeError, match=f"episode 7: {COLUMN}: .*{said}"):
            posed_by_column(dataset(list(cells.shape[1:])), FRONT, 7, settings(), {COLUMN: cells}.__getitem__)


def test_kept_scenes_of_a_column_ask_for_it_again() -> None:
    track = static_camera(intrinsics_from_fov(8, 8, 60.0), 5, 8, 8)
    with pytest.raises(ConfigError, match="name it: --camera"):
        new_poses(dataset([4, 4]), 0, CameraConfig(), {FRONT: track})
