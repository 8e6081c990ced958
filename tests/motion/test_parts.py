"""Splitting an instance into rigid parts."""

import torch

from lerobot_msdyn.motion.from_tracks.parts import split_rigid_parts


def agreement(part: torch.Tensor, truth: torch.Tensor) -> float:
    """Share of tracks that carry the most frequent part of their body."""
    right = 0
    for body in truth.unique():
        right += int(torch.bincount(part[truth == body]).max())
    return right / len(part)


def test_two_bodies_in_one_instance_are_two_parts(tumbling, late) -> None:
    xyz = torch.cat((tumbling.xyz, late.xyz))
    xyz = xyz + 1e-4 * torch.randn(xyz.shape, generator=torch.Generator().manual_seed(0))
    truth = torch.arange(2).repeat_interleave(60)
    part = split_rigid_parts(xyz, torch.ones(120, 24, dtype=torch.bool), torch.ones(120, 24), torch.ones_like(truth))
    assert part.unique().tolist() == [0, 1]
    assert agreement(part, truth) == 1


def test_a_rigid_instance_stays_whole(tumbling) -> None:
    xyz = tumbling.xyz + 1e-3 * torch.randn(60, 24, 3, generator=torch.Generator().manual_seed(0))
    instance = torch.full((60,), 3)
    part = split_rigid_parts(xyz, torch.ones(60, 24, dtype=torch.bool), torch.ones(60, 24), instance)
    assert part.tolist() == [0] * 60


def test_parts_are_numbered_over_all_instances(tumbling, resting, late) -> None:
    xyz = torch.cat((resting.xyz, tumbling.xyz, late.xyz))
    instance = torch.tensor([5] * 60 + [2] * 120)
    part = split_rigid_parts(xyz, torch.ones(180, 24, dtype=torch.bool), torch.ones(180, 24), instance)
    assert part[60:].unique().tolist() == [0, 1]
    assert part[:60].unique().tolist() == [2]


def test_no_more_parts_than_allowed(tumbling, late) -> None:
    xyz = torch.cat((tumbling.xyz, late.xyz))
    everywhere = torch.ones(120, 24)
    part = split_rigid_parts(xyz, everywhere > 0, everywhere, torch.ones(120, dtype=torch.long), max_parts=1)
    assert part.tolist() == [0] * 120


def test_no_tracks() -> None:
    none = torch.zeros(0, 24)
    part = split_rigid_parts(torch.zeros(0, 24, 3), none > 0, none, torch.zeros(0, dtype=torch.long))
    assert part.shape == (0,)


def test_tracks_that_follow_each_other_in_time_are_one_part(tumbling) -> None:
    """A rigid body whose first tracks end before the others begin."""
    valid = torch.zeros(60, 24, dtype=torch.bool)
    valid[:30, :12], valid[30:, 12:] = True, True
    part = split_rigid_parts(tumbling.xyz, valid, valid.float(), torch.ones(60, dtype=torch.long))
    assert part.tolist() == [0] * 60


def test_residuals_below_two_pixels_make_no_parts(tumbling) -> None:
    """Half of the tracks creep away by 3 mm, at 2 mm a pixel."""
    xyz = tumbling.xyz
    xyz[:30, :, 0] += torch.linspace(0, 0.003, 24)
    everywhere = torch.ones(60, 24)
    instance = torch.ones(60, dtype=torch.long)
    whole = split_rigid_parts(xyz, everywhere > 0, everywhere, instance, pixel_m=0.002)
    assert whole.tolist() == [0] * 60
