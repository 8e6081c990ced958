"""Where a camera sits on the gripper, by the gripper's poses and how the desk goes by."""

import numpy as np
import pytest
from ridden import FOV_DEG, FPS, FRAMES, WIDTH, Ridden

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.robots.calibration.hand_eye import HandEye, solve_hand_eye


def test_the_camera_is_found_with_its_focal_length_and_lag(ridden: Ridden) -> None:
    rgb, links, eye = ridden
    late = np.concatenate((links[:1], links[:-1]))  # each pose is recorded a frame late
    found = solve_hand_eye([rgb], [late], FPS, horizontal_fov_deg=60.0)
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


def test_a_camera_that_stands_tells_nothing(ridden: Ridden) -> None:
    rgb, links, _ = ridden
    with pytest.raises(PriorError, match="0 corners could be followed while the picture moves"):
        solve_hand_eye([np.repeat(rgb[:1], FRAMES, axis=0)], [links], FPS)
