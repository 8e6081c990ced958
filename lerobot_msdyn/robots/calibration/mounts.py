"""Where a robot's description says that cameras are: links named so, on the robot's head for example."""

import re

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray

from lerobot_msdyn.robots.calibration.search import Pose
from lerobot_msdyn.robots.description import Robot
from lerobot_msdyn.robots.kinematics import link_poses

NAMES = re.compile(r"(^|_)(cam(era)?|optical|realsense|d4\d\d|zed|oak)(_|\d|$)", re.IGNORECASE)
FOVS_DEG = (45, 56, 70)  # horizontal
AXES_FROM_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # of links whose x axis looks ahead (ROS REP 103)
STILL_M = 0.002  # by which a link may move and its camera be fixed


def mounted_cameras(robot: Robot, values: Float64[ndarray, "t j"]) -> list[Pose]:
    """Cameras at the links that are named as such and stand still: with several fields of view, which none tells.

    Args:
        robot: its description.
        values: of the movable joints in some frames (rad, m).
    """
    named = [index for index, name in enumerate(robot.links) if NAMES.search(name)]
    if not named:
        return []
    poses = link_poses(robot, torch.from_numpy(values)).numpy()[:, named]
    still = np.linalg.norm(poses - poses[:1], axis=(2, 3)).max(0) < STILL_M
    found = []
    for index, pose in zip(np.array(named)[still], poses[0][still], strict=True):
        optical = "optical" in robot.links[index].lower()
        rotation = (pose[:3, :3] if optical else pose[:3, :3] @ AXES_FROM_OPTICAL).T
        focals = [0.5 / float(np.tan(np.radians(fov) / 2)) for fov in FOVS_DEG]
        found += [Pose(rotation, -rotation @ pose[:3, 3], focal) for focal in focals]
    return found
