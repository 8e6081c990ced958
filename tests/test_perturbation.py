"""Camera changes: where the camera goes, and that it is the same every time."""

import math

import pytest
import torch

from lerobot_msdyn.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.config import JitterConfig, OrbitConfig, PerturbationConfig
from lerobot_msdyn.errors import ConfigError
from lerobot_msdyn.geometry import invert_se3, transform_points
from lerobot_msdyn.perturbation import draw_offset, draw_rng, look_at_distance, orbit_offset, perturb


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


@pytest.mark.parametrize("config", [OrbitConfig(), JitterConfig()])
def test_draw_is_a_function_of_seed_episode_and_variant(config: PerturbationConfig) -> None:
    def offset(*key: int) -> torch.Tensor:
        return draw_offset(config, 0.7, draw_rng(*key))[0]

    assert torch.equal(offset(0, 1, 2), offset(0, 1, 2))
    others = [offset(1, 1, 2), offset(0, 2, 2), offset(0, 1, 3)]
    assert not any(torch.equal(offset(0, 1, 2), other) for other in others)


def test_orbit_stays_in_range_and_says_what_it_drew() -> None:
    config = OrbitConfig(azimuth_deg=4.0, elevation_deg=2.0, translation_rel=0.0)
    for variant in range(50):
        offset, drawn = draw_offset(config, 0.5, draw_rng(0, 0, variant))
        assert abs(drawn["azimuth_deg"]) <= 4
        assert abs(drawn["elevation_deg"]) <= 2
        expected = orbit_offset(drawn["azimuth_deg"], drawn["elevation_deg"], 0.5)
        torch.testing.assert_close(offset, expected)


def test_nothing_allowed_means_nothing_changes() -> None:
    for config in (OrbitConfig(0.0, 0.0, 0.0), JitterConfig(0.0, 0.0)):
        torch.testing.assert_close(draw_offset(config, 0.7, draw_rng(0, 0, 0))[0], torch.eye(4))


def test_unknown_kind_is_refused() -> None:
    with pytest.raises(ConfigError, match="PerturbationConfig"):
        draw_offset(PerturbationConfig(), 0.7, draw_rng(0, 0, 0))


def test_the_change_is_in_the_cameras_own_axes_at_every_frame() -> None:
    pose = orbit_offset(40.0, 10.0, 1.0)
    camera = static_camera(intrinsics_from_fov(64, 48, 60.0), 3, 64, 48, pose)
    moved = perturb(camera, orbit_offset(5.0, 0.0, 1.0))
    torch.testing.assert_close(moved.world_from_camera[2], pose @ orbit_offset(5.0, 0.0, 1.0))
    assert torch.equal(moved.intrinsics, camera.intrinsics)


def test_look_at_distance_is_that_of_the_middle() -> None:
    depth = torch.full((8, 8), 5.0)
    depth[2:6, 2:6] = 0.7
    depth[3, 3] = 0
    assert look_at_distance(depth) == pytest.approx(0.7)
    assert look_at_distance(torch.zeros(8, 8)) == 1.0
