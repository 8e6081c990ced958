"""Camera changes as matrices."""

import math

import pytest
import torch

from lerobot_msdyn.core.geometry import invert_se3, transform_points
from lerobot_msdyn.core.perturbation import AMOUNTS
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


@pytest.mark.parametrize("tilt_deg", [0.0, 20.0, 35.0, 55.0])
@pytest.mark.parametrize("kind", ["azimuth_deg", "elevation_deg", "pan_deg", "tilt_deg"])
@pytest.mark.parametrize("angle", [-15.0, 15.0])
def test_what_is_upright_stays_upright(tilt_deg: float, kind: str, angle: float) -> None:
    """The camera's horizontal axis stays horizontal, and the view turns by the angle that was asked for."""
    tilt = math.radians(tilt_deg)
    up = (0.0, -math.cos(tilt), -math.sin(tilt))
    amounts = torch.zeros(1, len(AMOUNTS))
    amounts[0, AMOUNTS.index(kind)] = angle
    offset = offsets(amounts, 0.7, up)[0]
    right, _, ahead = offset[:3, :3].T
    assert abs(float(right @ torch.tensor(up))) < 1e-6
    level = ahead - (ahead @ torch.tensor(up)) * torch.tensor(up)
    before = torch.tensor([0.0, 0.0, 1.0]) - (-math.sin(tilt)) * torch.tensor(up)
    turned = math.degrees(math.acos(min(1.0, float(level @ before / level.norm() / before.norm()))))
    new_tilt = math.degrees(math.asin(-float(ahead @ torch.tensor(up))))
    horizontal = kind in ("azimuth_deg", "pan_deg")
    assert turned == pytest.approx(abs(angle) if horizontal else 0.0, abs=0.1)
    expected = {"elevation_deg": tilt_deg + angle, "tilt_deg": tilt_deg - angle}.get(kind, tilt_deg)
    assert new_tilt == pytest.approx(expected, abs=0.01)


def test_a_camera_that_looks_straight_down_turns_about_its_own_axes() -> None:
    down = (0.0, -math.cos(math.radians(85)), -math.sin(math.radians(85)))
    torch.testing.assert_close(orbit_offset(10.0, 4.0, 0.7, down), orbit_offset(10.0, 4.0, 0.7))
