"""Depth that no surface has."""

import math

import torch

from lerobot_msdyn.priors.depth.flying_pixels import clean_recorded_depth, without_flying_pixels


def test_both_ends_of_the_recorded_range_are_unknown() -> None:
    depth = torch.full((1, 6, 6), 1.0)
    depth[0, :3, :3] = 0.0101  # LeRobot's missing pixel, after its codec
    depth[0, 3:, 3:] = 9.99  # and its "farther than the range"
    cleaned = clean_recorded_depth(depth, 0.01, 10.0)
    assert (cleaned[0, :3, :3] == 0).all()
    assert (cleaned[0, 3:, 3:] == 0).all()
    assert (cleaned[0, :3, 3:] == 1).all()


def test_a_range_without_ends_keeps_everything_that_is_a_number() -> None:
    depth = torch.full((1, 5, 5), 3.0)
    depth[0, 2, 2] = torch.inf
    depth[0, 0, 0] = torch.nan
    cleaned = clean_recorded_depth(depth, 0.0, math.inf)
    assert (cleaned == 0).sum() == 2
    assert cleaned[0, 4, 4] == 3


def test_flying_pixels_go_and_true_edges_stay() -> None:
    depth = torch.full((1, 8, 8), 1.0)
    depth[:, :, 4:] = 2.0
    expected = depth.clone()
    depth[0, 3, 4] = 1.5  # hangs between the two surfaces
    expected[0, 3, 4] = 0
    torch.testing.assert_close(clean_recorded_depth(depth, 0.0, math.inf), expected)


def test_a_ramp_between_two_surfaces_goes() -> None:
    depth = torch.full((1, 9, 12), 1.0)
    depth[:, :, 5], depth[:, :, 6], depth[:, :, 7:] = 1.3, 1.6, 2.0
    cleaned = without_flying_pixels(depth)
    assert (cleaned[0, 1:-1, 5:7] == 0).all()
    assert (cleaned[0, :, :5] == 1).all()
    assert (cleaned[0, :, 7:] == 2).all()
