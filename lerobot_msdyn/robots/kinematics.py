"""Where the links are: batched, differentiable forward kinematics."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.geometry import se3
from lerobot_msdyn.robots.description import MOVABLE, Robot


def link_poses(robot: Robot, values: Float[Tensor, "*b j"]) -> Float[Tensor, "*b l 4 4"]:
    """Poses of all links in the frame of the root (m).

    Args:
        robot: the robot.
        values: of `robot.movable`, in this order: rad, or m.
    """
    value_of = dict(zip(robot.movable, values.unbind(-1), strict=True))
    poses: dict[int, Tensor] = {}
    for joint in robot.joints:
        value = value_of.get(joint.mimics or joint.name)
        parent = poses.setdefault(joint.parent, torch.eye(4, dtype=values.dtype).expand(*values.shape[:-1], 4, 4))
        origin = torch.from_numpy(joint.parent_from_joint).to(values)
        moved = parent @ origin
        if value is not None and joint.kind in MOVABLE:
            axis = torch.from_numpy(np.asarray(joint.axis)).to(values)
            moved = moved @ _motion(joint.kind, axis, joint.factor * value + joint.offset)
        poses[joint.child] = moved
    return torch.stack([poses[index] for index in range(len(robot.links))], dim=-3)


def _motion(kind: str, axis: Float[Tensor, "3"], value: Float[Tensor, "*b"]) -> Float[Tensor, "*b 4 4"]:
    if kind == "prismatic":
        return se3(torch.eye(3, dtype=value.dtype).expand(*value.shape, 3, 3), axis * value[..., None])
    x, y, z = axis.tolist()
    cross = value.new_tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine, versine = torch.sin(value)[..., None, None], (1 - torch.cos(value))[..., None, None]
    rotation = torch.eye(3, dtype=value.dtype) + sine * cross + versine * (cross @ cross)
    return se3(rotation, torch.zeros_like(value)[..., None].expand(*value.shape, 3))
