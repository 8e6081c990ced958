"""A camera whose poses the dataset itself records: found, shared between episodes, and written for the new views."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from augment_command import FRONT, run
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_tools import add_features
from scipy.spatial.transform import Rotation
from walking import FRAMES, HEIGHT, WIDTH, walk_along

from lerobot_msdyn.augment.backgrounds import seen_together
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.geometry import invert_se3
from lerobot_msdyn.dataset.read import open_source, read_episode
from lerobot_msdyn.priors.exchange import Exchange, write_exchange
from lerobot_msdyn.reconstruction.shown_elsewhere import Shown
from lerobot_msdyn.synthetic.dataset import write_dataset

COLUMN = "observation.camera_pose"  # position and quaternion wxyz, of a camera that looks along -z (ARKit)
ARCS = ((-25.0, -5.0), (-10.0, 15.0))  # degrees of azimuth
NAMES = ["x", "y", "z", "qw", "qx", "qy", "qz"]
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
FAST = ["--fit.steps", "20", "--scene.moving_frames", "4", "--scene.moving_gaussians", "500", "--variants", "1"]
BY_COLUMN = ["--camera.pose_columns", f"{{front: {COLUMN}}}", "--camera.pose_axes", "opengl"]


def cells_of(world_from_camera: torch.Tensor) -> np.ndarray:
    poses = (world_from_camera @ FLIP).double().numpy()
    turned = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
    return np.concatenate([poses[:, :3, 3], turned], 1).astype(np.float32)


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a dataset `posed`, recorded with depth, and files of true masks, K and poses."""
    folder = tmp_path_factory.mktemp("posed")
    scenes, cells = [], []
    for episode, arc in enumerate(ARCS):
        scene, view, priors = walk_along(arc, episode=episode)
        scenes.append(dataclasses.replace(scene, cameras={"front": view.camera}))
        cells.append(cells_of(view.camera.world_from_camera))
        poses, K = view.camera.camera_from_world.numpy(), view.camera.intrinsics.numpy()
        masks = priors.instances.numpy()
        write_exchange(
            folder / f"{episode}.npz", Exchange(FRAMES, HEIGHT, WIDTH, episode, FRONT, masks=masks, K=K, w2c=poses)
        )
    calibration = {"cameras": {"front": {"K": scenes[0].cameras["front"].intrinsics[0].tolist()}}}
    (folder / "calibration.json").write_text(json.dumps(calibration))
    write_dataset(scenes, "local/walks", folder / "walks", depth=True)
    recorded = LeRobotDataset("local/walks", root=folder / "walks", video_backend="pyav")
    feature = {"dtype": "float32", "shape": (7,), "names": NAMES}
    add_features(recorded, {COLUMN: (np.concatenate(cells), feature)}, folder / "posed", "local/posed")
    return folder


def command(walks: Path, out: Path, *more: str) -> list[str]:
    source = ["--repo", "local/posed", "--root", str(walks / "posed"), "--new_root", str(out), "--episodes", "[0]"]
    masks = ["--allow_moving", "true", "--priors.masks", f"{walks}/{{episode}}.npz", "--workers", "1"]
    calibration = ["--camera.calibration", str(walks / "calibration.json"), "--perturbation.type", "translation"]
    return [*source, *masks, *calibration, "--scene.shared_background", "false", *FAST, *more]


@pytest.fixture(scope="module")
def new(walks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output by the column."""
    out = tmp_path_factory.mktemp("by_column") / "new"
    assert run(*command(walks, out, *BY_COLUMN)) == 0
    return out


def test_poses_of_a_column_do_what_those_of_files_do(walks: Path, new: Path, tmp_path: Path) -> None:
    assert run(*command(walks, tmp_path / "new", "--camera.poses", f"{walks}/{{episode}}.npz")) == 0
    pictures = [
        LeRobotDataset("local/new", root=out, episodes=[1], video_backend="pyav") for out in (new, tmp_path / "new")
    ]
    for t in (0, FRAMES - 1):
        by_column, by_file = (dataset[t][FRONT] for dataset in pictures)
        assert (by_column - by_file).abs().mean() < 0.03


def test_the_new_episode_says_where_its_camera_is(walks: Path, new: Path) -> None:
    recorded = LeRobotDataset("local/posed", root=walks / "posed", episodes=[0], video_backend="pyav")
    dataset = LeRobotDataset("local/new", root=new, video_backend="pyav")
    record = json.loads(pq.read_table(new / "meta" / "msdyn" / "episodes.parquet").to_pylist()[1]["views"])[FRONT]
    offset = invert_se3(torch.tensor(record["camera_from_source"]))
    rows = torch.stack([dataset[i][COLUMN] for i in range(2 * FRAMES)])
    source = torch.stack([recorded[i][COLUMN] for i in range(FRAMES)])
    assert torch.equal(rows[:FRAMES], source)
    _, view, _ = walk_along(ARCS[0])
    stated = cells_of(view.camera.world_from_camera @ offset)
    np.testing.assert_allclose(rows[FRAMES:, :3], stated[:, :3], atol=0.01)  # m: poses are refined
    assert (rows[FRAMES:, :3] - source[:, :3]).norm(dim=1).min() > 0.02
    assert (rows[FRAMES:, 3:] * source[:, 3:]).sum(1).min() > 0.999  # of two quaternions, the one of the recording
    assert dataset.meta.stats[COLUMN]["max"][0] == pytest.approx(float(rows[:, 0].max()), abs=1e-5)


def test_episodes_whose_poses_are_columns_share_what_stands_still(walks: Path) -> None:
    source, recipe = open_source("local/posed", walks / "posed"), Recipe()
    recipe.camera.pose_columns, recipe.camera.pose_axes = {"front": COLUMN}, "opengl"
    recipe.camera.calibration, recipe.priors.cache = walks / "calibration.json", "off"
    recipe.priors.masks = f"{walks}/{{episode}}.npz"
    found = seen_together(source, [FRONT], recipe)[FRONT]
    assert [shown.episode for shown in found if isinstance(shown, Shown)] == [0, 1]
    camera = read_episode(source, 0, [FRONT], recipe.camera).views[FRONT].camera
    assert not camera.is_static
    assert (
        camera.intrinsics[0].tolist() == json.loads((walks / "calibration.json").read_text())["cameras"]["front"]["K"]
    )


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--camera.pose_columns", "{front: pose}"], "camera.pose_columns names 'pose'; expected one of local/posed's"),
        (["--camera.pose_columns", f"{{side: {COLUMN}}}"], "camera.pose_columns names the camera 'side'"),
        ([*BY_COLUMN, "--camera.pose_rotation", "matrix"], "cannot be read as poses as matrix"),
    ],
)
def test_a_column_that_is_not_there_ends_the_command_before_anything_is_written(
    walks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], said: str
) -> None:
    assert run(*command(walks, tmp_path / "new", *flags)) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert not (tmp_path / "new").exists()
