"""Levels of motion."""

import math

import torch

from lerobot_msdyn.core.geometry import axis_angle_to_matrix, se3
from lerobot_msdyn.motion.model.bases import identity_level, knot_frames, level_affines, level_from_motions, with_idle


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
    level = level_from_motions(motion, torch.zeros(2, 3), active=torch.tensor([True, False]))
    affines = level_affines(level, torch.arange(3))
    torch.testing.assert_close(affines[1], torch.eye(3, 4).expand(3, 3, 4))
    assert not torch.allclose(affines[0], torch.eye(3, 4).expand(3, 3, 4))


def test_knots_meet_the_canonical_frame_and_both_ends() -> None:
    assert knot_frames(10, 4, canonical=6).tolist() == [0, 2, 6, 9]
    assert knot_frames(1, 4).tolist() == [0]


def test_between_knots_a_motion_is_interpolated_and_beyond_them_held() -> None:
    motions = torch.eye(4).repeat(1, 5, 1, 1)
    motions[0, :, 0, 3] = torch.tensor([0.0, 9.0, 2.0, 9.0, 4.0])
    level = level_from_motions(motions, torch.zeros(1, 3), frames_per_knot=2)
    assert level.knots.tolist() == [0, 2, 4]
    shift = level_affines(level, torch.tensor([-1.0, 1.0, 2.5, 4.0, 7.0]))[0, :, 0, 3]
    torch.testing.assert_close(shift, torch.tensor([0.0, 1.0, 2.5, 4.0, 4.0]))


def test_the_idle_basis_stands_last_and_still() -> None:
    motion = se3(axis_angle_to_matrix(torch.ones(2, 3, 3)), torch.ones(2, 3, 3))
    level = with_idle(level_from_motions(motion, torch.zeros(2, 3)))
    assert level.active.tolist() == [True, True, False]
    torch.testing.assert_close(level_affines(level, torch.arange(3))[2], torch.eye(3, 4).expand(3, 3, 4))
