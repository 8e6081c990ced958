"""Camera changes as matrices."""

import math

import pytest
import torch

from lerobot_msdyn.core.geometry import invert_se3, transform_points
from lerobot_msdyn.views.offsets import amounts_of_pose, offsets, orbit_offset


def test_orbit_keeps_the_distance_and_looks_at_the_point() -> None:
    target = torch.tensor([[0.0, 0.0, 0.7]])
    for azimuth, elevation in ((10.0, 0.0), (0.0, 8.0), (-15.0, 5.0)):
        offset = orbit_offset(azimuth, elevation, 0.7)
        assert float((offset[:3, 3] - target[0]).norm()) == pytest.approx(0.7, abs=1e-6)
        seen = transform_points(invert_se3(offset), target)
        torch.testing.assert_close(seen, target, atol=1e-6, rtol=0)


def test_positive_azimuth_is_right_and_positive_elevation_up() -> None:
    right = orbit_offset(90.0, 0.0, 2.0)[:3, 3]
    torch.testing.assert_close(right, torch.tensor([2.0, 0.0, 2.0]), atol=1e-6, rtol=0)
    up = orbit_offset(0.0, 30.0, 2.0)[:3, 3]
    torch.testing.assert_close(up, torch.tensor([0.0, -1.0, 2 - math.sqrt(3)]), atol=1e-6, rtol=0)


def test_a_pose_and_its_amounts_say_the_same() -> None:
    pose = orbit_offset(20.0, -7.0, 0.7)
    again = offsets(torch.from_numpy(amounts_of_pose(pose)), 0.7)[0]
    torch.testing.assert_close(again, pose, atol=1e-5, rtol=0)
