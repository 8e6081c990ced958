"""Depth: the table plane."""

import dataclasses
import math

import pytest
import torch

from lerobot_msdyn.core.cameras import static_camera
from lerobot_msdyn.core.geometry import unproject_image
from lerobot_msdyn.priors.depth.table_plane import (
    ground_plane,
    table_plane,
    with_standing,
    without_holes,
)
from lerobot_msdyn.priors.depth.uprights import with_boxes

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


@pytest.mark.parametrize("size", [(0.04, 0.04, 0.04), (0.04, 0.04, 0.12)])
def test_things_stand_upright_on_a_known_ground(size: tuple[float, float, float]) -> None:
    tilt, focal = math.radians(40), 600.0
    pose = torch.eye(4)
    pose[:3, 1] = torch.tensor([0, -math.sin(tilt), -math.cos(tilt)])
    pose[:3, 2] = torch.tensor([0, math.cos(tilt), -math.sin(tilt)])
    pose[2, 3] = 0.4
    intrinsics = torch.tensor([[focal, 0, 160], [0, focal, 120], [0, 0, 1.0]])
    camera = dataclasses.replace(static_camera(intrinsics, 2, 320, 240), world_from_camera=pose.expand(2, 4, 4))
    rays = unproject_image(torch.ones(240, 320), intrinsics) @ pose[:3, :3].T
    low, high = torch.tensor([0.011, 0.42, 0.0]), torch.tensor([0.011, 0.42, 0.0]) + torch.tensor(size)
    crossings = torch.stack([(corner - pose[:3, 3]) / rays for corner in (low, high)])  # of a box, in m of z
    enters, leaves = crossings.amin(0).amax(-1), crossings.amax(0).amin(-1)
    its = enters < leaves
    ground, instances = ground_plane(camera, 0.0), its.to(torch.uint8).expand(2, -1, -1)
    on_foot = with_standing(ground, instances)
    standing = with_boxes(on_foot, instances, camera, 0.0)
    off = [float((depth[0] - enters)[its].abs().mean()) for depth in (on_foot, standing)]
    assert off[0] > 0.012
    assert off[1] < 0.4 * off[0]
    assert torch.equal(standing[0][~its], on_foot[0][~its])
