"""The camera at given poses."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from lerobot_msdyn.core.perturbation import Perturbation, Viewpoint

TOLERANCE = 1e-3  # of the products of a rotation's rows


@Perturbation.register_subclass("poses")
@dataclass
class Poses(Perturbation):
    """Given poses, one after the other over the variants."""

    allows_per_frame: ClassVar[bool] = False
    refuses_behind: ClassVar[bool] = True

    # Each the first three rows of (new camera from recorded camera), 12 numbers row by row; metres.
    poses: list[list[float]] = field(default_factory=list)

    def problems(self) -> list[str]:
        """What is wrong between fields."""
        none = [] if self.poses else ["poses is empty; expected at least one pose of 12 numbers"]
        bad = [
            f"poses[{number}] is no rigid motion; expected 12 numbers, three rows of a rotation and a shift in metres"
            for number, pose in enumerate(self.poses)
            if not _is_rigid(pose)
        ]
        return [*none, *bad, *super().problems()]

    def amounts(self, shares: Float32[ndarray, "s n"], view: Viewpoint, variant: int) -> Float32[ndarray, "s n"]:
        """Those of the pose whose turn it is."""
        import torch

        from lerobot_msdyn.core.geometry import invert_se3
        from lerobot_msdyn.views.offsets import amounts_of_pose

        row = self.poses[variant % len(self.poses)]
        new_from_recorded = torch.tensor([*row, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)
        return amounts_of_pose(invert_se3(new_from_recorded))


def _is_rigid(pose: list[float]) -> bool:
    """Whether 12 numbers, row by row, are a rotation and a shift."""
    if len(pose) != 12:
        return False
    rotation = np.reshape(pose, (3, 4))[:, :3]
    orthonormal = np.abs(rotation @ rotation.T - np.eye(3)).max() < TOLERANCE
    return bool(orthonormal and np.linalg.det(rotation) > 0)
