"""What a robot's joints say of masks and depth goes before what others do, in the robot's pixels."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.priors.registry import Depth, Masks

RELATIVE_ERROR = 0.03  # of depth by a calibrated robot


def with_robot(instances: Masks, moving: Bool[Tensor, "t h w"]) -> Masks:
    """Instances whose largest part in the robot's moving pixels is the robot: all of these pixels are its."""
    if not bool(moving.any()):
        return instances
    shares = torch.bincount(instances[moving].long(), minlength=2)
    shares[0] = 0
    robot = int(shares.argmax()) if bool(shares.any()) else min(int(instances.max()) + 1, 255)
    return torch.where(moving, torch.tensor(robot, dtype=torch.uint8), instances)


def with_robot_depth(depth: Depth, robot: Float[Tensor, "t h w"]) -> Depth:
    """Depth with the robot's (m, 0 = none), unless a sensor measured it."""
    if depth.traits.metric and depth.traits.measured:
        return depth
    return replace(depth, z=torch.where(robot > 0, robot, depth.z))
