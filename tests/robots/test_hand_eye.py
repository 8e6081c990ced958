"""Where a camera sits on the gripper, by the gripper's poses and how the desk goes by."""

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, se3
from lerobot_msdyn.robots.calibration.hand_eye import HandEye, solve_hand_eye
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.scene import SyntheticScene
from lerobot_msdyn.synthetic.viewpoints import recorded_cameras

FRAMES, WIDTH, HEIGHT, FPS = 36, 160, 120, 10
FOV_DEG = 70.0  # of the synthetic wrist camera


@pytest.fixture(scope="module")
def ridden() -> tuple[SyntheticScene, np.ndarray, np.ndarray, np.ndarray]:
    """A scene, the pictures of a camera that is carried over the desk, its link's poses, and link from camera."""
    scene = make_scene("static", 0, FRAMES, WIDTH, HEIGHT)
    time = torch.linspace(0, 1, FRAMES, dtype=torch.float64)
    turns = torch.stack((0.15 * (5 * time).sin(), 0.15 * (4 * time).cos(), 0.5 * (3 * time).sin()), dim=1)
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    places = torch.stack((0.10 * (6 * time).sin(), 0.05 + 0.08 * time, 0.40 + 0.06 * (7 * time).cos()), dim=1)
    links = se3(axis_angle_to_matrix(turns) @ down, places).numpy()
    eye = se3(axis_angle_to_matrix(torch.tensor([[0.1, -0.08, 0.6]], dtype=torch.float64))[0], torch.zeros(3).double())
    eye[:3, 3] = torch.tensor([0.03, -0.04, 0.02])
    wrist = recorded_cameras(links, WIDTH, HEIGHT)["wrist"]
    camera = type(wrist)(wrist.intrinsics, torch.from_numpy(links @ eye.numpy()).float(), WIDTH, HEIGHT)
    return scene, scene.render(camera, [0] * FRAMES).rgb.numpy(), links, eye.numpy()


def test_the_camera_is_found_with_its_focal_length_and_lag(
    ridden: tuple[SyntheticScene, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    _, rgb, links, eye = ridden
    late = np.concatenate((links[:1], links[:-1]))  # each pose is recorded a frame late
    found = solve_hand_eye(rgb, late, FPS, horizontal_fov_deg=60.0)
    focal = WIDTH / 2 / np.tan(np.radians(FOV_DEG) / 2)
    assert found.focal_px == pytest.approx(focal, rel=0.04)
    assert found.lag_s * FPS == pytest.approx(1.0, abs=0.15)
    assert found.ground_m == pytest.approx(0.0, abs=0.02)
    turn = found.link_from_camera[:3, :3].T @ eye[:3, :3]
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 2.0
    assert np.linalg.norm(found.link_from_camera[:3, 3] - eye[:3, 3]) < 0.02  # m
    middle = slice(2, -2)
    away = found.poses(late, FPS)[middle, :3, 3] - (links @ eye)[middle, :3, 3]
    assert np.median(np.linalg.norm(away, axis=1)) < 0.02


def test_depth_of_the_ground_is_along_the_axis() -> None:
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 0.5
    depth = HandEye(np.eye(4), 100.0, 0.1, 0.0, 0.0).ground_depth(pose[None], 8, 6)
    np.testing.assert_allclose(depth, 0.4)
    pose[:3, :3] = np.diag([1.0, 1.0, 1.0])  # looks up
    assert (HandEye(np.eye(4), 100.0, 0.1, 0.0, 0.0).ground_depth(pose[None], 8, 6) == 0).all()


def test_a_camera_that_stands_tells_nothing(
    ridden: tuple[SyntheticScene, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    _, rgb, links, _ = ridden
    with pytest.raises(PriorError, match="0 corners could be followed while the picture moves"):
        solve_hand_eye(np.repeat(rgb[:1], FRAMES, axis=0), links, FPS)
