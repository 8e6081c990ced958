"""Gaps: what carries a part while it cannot be followed."""

import math

import torch

from lerobot_msdyn.core.geometry import axis_angle_to_matrix, invert_se3, se3, transform_points
from lerobot_msdyn.motion.estimate import initialise_objects
from lerobot_msdyn.motion.from_tracks.gaps import STILL, fill_gaps, find_carriers


def turning() -> tuple[torch.Tensor, torch.Tensor]:
    """A steady quarter turn about a shifting pivot in 7 frames, and the pivot at the first."""
    angle = torch.linspace(0, math.pi / 2, 7)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    pivot = torch.tensor([1.0, 2.0, 0.0])
    shift = torch.linspace(0, 0.6, 7)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    rotation = axis_angle_to_matrix(angle)
    return se3(rotation, pivot + shift - rotation @ pivot), pivot


def test_gaps_are_bridged_inside_and_held_outside() -> None:
    truth, pivot = turning()
    broken = truth.clone()
    broken[[0, 3, 4, 6]] = torch.eye(4)
    filled = fill_gaps(broken, torch.tensor([False, True, True, False, False, True, False]), pivot)
    torch.testing.assert_close(filled[1:6], truth[1:6], atol=1e-5, rtol=0)
    torch.testing.assert_close(filled[0], truth[1])
    torch.testing.assert_close(filled[6], truth[5])


def test_a_carried_part_goes_with_its_carrier_also_outside() -> None:
    truth, pivot = turning()
    broken = truth.clone()
    broken[[0, 3, 4, 5, 6]] = torch.eye(4)
    accepted = torch.tensor([False, True, True, False, False, False, False])
    carrier = truth @ invert_se3(truth[4])  # the same motion, from another reference frame
    torch.testing.assert_close(fill_gaps(broken, accepted, pivot, carrier), truth, atol=1e-5, rtol=0)


def test_without_any_accepted_frame_nothing_moves() -> None:
    filled = fill_gaps(torch.full((3, 4, 4), 7.0), torch.zeros(3, dtype=torch.bool), torch.zeros(3))
    torch.testing.assert_close(filled, torch.eye(4).expand(3, 4, 4))


def test_the_carrier_is_what_moves_alike_beside_the_gap(tumbling, late, resting) -> None:
    motions = torch.stack([body.motions for body in (tumbling, tumbling, late, resting, resting)])
    accepted = torch.ones(5, 24, dtype=torch.bool)
    accepted[0, 14:] = False  # moves with 1
    accepted[4, 5:9] = False  # rests
    pivots = torch.stack([body.points.mean(0) for body in (tumbling, tumbling, late, resting, resting)])
    assert find_carriers(motions, accepted, pivots).tolist() == [1, STILL, STILL, STILL, STILL]


def test_what_is_not_followed_through_the_gap_carries_nothing(tumbling) -> None:
    motions = tumbling.motions.expand(2, -1, -1, -1)
    accepted = torch.ones(2, 24, dtype=torch.bool)
    accepted[:, 14:] = False
    assert find_carriers(motions, accepted, tumbling.points.mean(0).expand(2, 3)).tolist() == [STILL, STILL]


def test_a_hidden_block_goes_with_the_gripper_and_is_met_again(tumbling) -> None:
    """Sixteen tracks of the body make the block: half see its start, the others its end, none the middle."""
    valid = torch.ones(60, 24, dtype=torch.bool)
    valid[44:52, 9:], valid[52:, :15] = False, False
    part = torch.tensor([0] * 44 + [1] * 16)
    confidence = torch.ones(60, 24)
    level, points = initialise_objects(tumbling.xyz, valid, confidence, part, 0)
    torch.testing.assert_close(points, tumbling.xyz[:, 0], atol=1e-4, rtol=0)
    rotated = transform_points(tumbling.relative(0), level.pivots[1].expand(24, 1, 3))[:, 0] - level.pivots[1]
    torch.testing.assert_close(level.displacements[1], rotated, atol=1e-4, rtol=0)
