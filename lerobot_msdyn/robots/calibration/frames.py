"""Which frames are looked at, and where the links are in them."""

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray

from lerobot_msdyn.robots.description import Robot
from lerobot_msdyn.robots.kinematics import link_poses


def surface(robot: Robot, values: Float64[ndarray, "t j"]) -> Float32[ndarray, "t n 3"]:
    """Points of the robot's surface in its root's frame (m) in every frame."""
    poses = link_poses(robot, torch.from_numpy(values)).numpy().astype(np.float32)
    out = np.empty((len(values), len(robot.points), 3), np.float32)
    for link in range(len(robot.links)):
        chosen = robot.point_link == link
        out[:, chosen] = robot.points[chosen] @ poses[:, link, :3, :3].transpose(0, 2, 1) + poses[:, link, None, :3, 3]
    return out


def spread_frames(points: Float32[ndarray, "t n 3"], count: int) -> Int64[ndarray, " k"]:
    """Frames in which the robot stands as differently as can be: each is the farthest from those before it."""
    poses = points[:, :: max(1, points.shape[1] // 60)].reshape(len(points), -1)
    chosen = [int(((poses - poses.mean(0)) ** 2).sum(1).argmax())]
    nearest = ((poses - poses[chosen[0]]) ** 2).sum(1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, ((poses - poses[chosen[-1]]) ** 2).sum(1))
    return np.array(chosen)
