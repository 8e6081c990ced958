"""What a frame says of single points: a wall of uniform grey, 1 m away, that moves."""

import numpy as np
import pytest

from lerobot_msdyn.motion.to_video.kernels import OUTLIER, UNSEEN, Maps, frame_costs
from lerobot_msdyn.render.cpu.threads import run

SIDE = 40
GREY = 100


@pytest.fixture
def wall() -> Maps:
    intrinsics = np.array([[[100, 0, SIDE / 2], [0, 100, SIDE / 2], [0, 0, 1]]], np.float32)
    shape = (1, SIDE, SIDE)
    return Maps(
        np.ones(shape, np.float32),
        np.ones(shape, bool),
        np.full(shape, GREY, np.uint8),
        np.zeros(shape, np.uint8),
        intrinsics,
        0.01,
    )


def cost(maps: Maps, z: float, grey: float = GREY, towards: float = -1.0, x: float = 0.0) -> float:
    points = np.array([[[x, 0.0, z]]], np.float32)
    normals = np.array([[[0.0, 0.0, towards]]], np.float32)
    costs = np.zeros((1, 1), np.float32)
    run(frame_costs, 1, points, normals, np.array([grey], np.float32), np.array([0]), maps, costs)
    return float(costs[0, 0])


def test_a_point_on_the_surface_costs_nothing(wall: Maps) -> None:
    assert cost(wall, 1.0) == pytest.approx(0, abs=1e-6)


def test_distance_and_colour_cost(wall: Maps) -> None:
    off_by_outlier = 0.5 * OUTLIER * wall.pixel_m
    assert cost(wall, 1.0 + off_by_outlier) == pytest.approx(0.5, abs=1e-3)
    assert cost(wall, 1.0, GREY + 8.0 * OUTLIER) == pytest.approx(0.5, abs=1e-3)


def test_what_cannot_be_seen_tells_nothing(wall: Maps) -> None:
    behind, averted, outside_the_image = cost(wall, 2.0), cost(wall, 1.0, towards=1.0), cost(wall, 1.0, x=1.0)
    assert behind == averted == outside_the_image == UNSEEN


def test_a_point_far_in_front_is_contradicted(wall: Maps) -> None:
    assert cost(wall, 0.5) > 0.99


def test_a_point_before_what_stands_still_is_contradicted(wall: Maps) -> None:
    still = wall._replace(outside=np.full_like(wall.outside, 16))
    assert cost(still, 0.9) > 0.5
    assert cost(still, 1.5) == UNSEEN
