"""Depth: the table plane."""

import math

import pytest
import torch

from lerobot_msdyn.priors.depth.table_plane import table_plane, with_standing, without_holes

K = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])


def test_the_table_is_where_trigonometry_puts_it() -> None:
    depth = table_plane(64, 48, K, height_m=0.5, tilt_deg=30.0)
    assert depth.shape == (48, 64)
    # the row through the principal point looks 30 degrees down: 0.5 / sin 30 = 1 m
    assert (depth[23, 0] + depth[24, 0]).item() / 2 == pytest.approx(1.0, abs=2e-3)
    # 23.5 px below, the ray descends cos 30 * 0.47 + sin 30 metres per metre of z
    assert depth[47, 5].item() == pytest.approx(0.5 / (0.47 * math.cos(math.pi / 6) + 0.5), rel=1e-5)
    assert depth[0, 0].item() == pytest.approx(2.0)  # the wall, twice as far as the centre


def test_a_moving_thing_stands_on_the_table() -> None:
    instances = torch.zeros(20, 48, 64, dtype=torch.uint8)
    instances[:, 10:40, 20:30] = 1
    instances[7, 10:40, 20:30] = 0  # out of sight for a frame
    empty = table_plane(64, 48, K, 0.5, 30.0)
    depth = with_standing(empty, instances)
    foot = empty[39, 25].item()
    assert depth[0, 12, 25].item() == pytest.approx(foot, rel=0.02)
    assert depth[0, 39, 25] == depth[0, 12, 25]
    torch.testing.assert_close(depth[7], empty)


def test_spots_that_a_mask_misses_are_as_far_as_what_is_around_them() -> None:
    mask = torch.zeros(2, 20, 20, dtype=torch.bool)
    mask[0, 4:16, 4:16] = True
    mask[1, 4:16, 4:16] = True
    mask[1, 8:10, 8:10] = False
    mask[1, 12:16, 10:12] = False  # open below
    whole = without_holes(mask)
    assert torch.equal(whole[0], mask[0])
    assert whole[1, 8:10, 8:10].all()
    assert not whole[1, 12:16, 10:12].any()
