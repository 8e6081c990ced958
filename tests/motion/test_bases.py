"""Levels of motion."""

import math

import torch

from lerobot_msdyn.geometry import axis_angle_to_matrix, se3
from lerobot_msdyn.motion.bases import MotionLevel, identity_level, level_affines, level_from_motions


def test_identity_level_moves_nothing() -> None:
    affines = level_affines(identity_level(torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]), 5), torch.arange(5))
    assert affines.shape == (2, 5, 3, 4)
    torch.testing.assert_close(affines, torch.eye(3, 4).expand(2, 5, 3, 4))


def test_level_of_motions_gives_the_motions_back() -> None:
    rotation = axis_angle_to_matrix(torch.tensor([[0.0, 0.0, math.pi / 2]]))
    motion = se3(rotation, torch.tensor([[0.1, 0.2, 0.3]]))
    level = level_from_motions(torch.stack((torch.eye(4)[None], motion), dim=1), torch.tensor([[1.0, 0.0, 0.0]]))
    # the pivot (1, 0, 0) goes to (0, 1, 0) + (0.1, 0.2, 0.3)
    torch.testing.assert_close(level.displacements[0, 1], torch.tensor([-0.9, 1.2, 0.3]))
    torch.testing.assert_close(level_affines(level, torch.tensor([1]))[0, 0], motion[0, :3])
    assert level.parents.tolist() == [-1]


def test_an_inactive_basis_is_the_identity() -> None:
    motion = se3(axis_angle_to_matrix(torch.ones(2, 3, 3)), torch.ones(2, 3, 3))
    level = level_from_motions(motion, torch.zeros(2, 3))
    level = MotionLevel(
        level.rotations_6d, level.displacements, level.pivots, level.parents, active=torch.tensor([True, False])
    )
    affines = level_affines(level, torch.arange(3))
    torch.testing.assert_close(affines[1], torch.eye(3, 4).expand(3, 3, 4))
    assert not torch.allclose(affines[0], torch.eye(3, 4).expand(3, 3, 4))
