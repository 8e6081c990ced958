"""Whether a camera stands, was moved, drifts or moves, whatever is before it."""

import numpy as np
import pytest
import torch
from panned import WIDTH, along, panned

from lerobot_msdyn.priors.camera.path import camera_path, displacement_px, distances_px
from lerobot_msdyn.priors.camera.stands import Stands, stands_along

FRAMES = 24
STILL = np.zeros((FRAMES, 2))


def sweeping(t: int) -> tuple[int, int]:
    """Half of the picture, to and fro."""
    middle = int(WIDTH / 2 + 70 * np.sin(t / 12))
    return middle - WIDTH // 4, middle + WIDTH // 4


def camera_stands(rgb: torch.Tensor) -> Stands:
    return stands_along(camera_path(rgb), rgb)


def is_steady(found: Stands) -> bool:
    return not found.moves and len(found.stands) == 1 and found.stands[0].path is None


@pytest.mark.parametrize(
    "rgb",
    [
        panned(STILL),
        panned(STILL, arm=sweeping),
        panned(STILL, arm=sweeping, contrast=0.25),
        panned(STILL, arm=sweeping, gain=lambda t: 1 + 0.3 * np.sin(t / 3)),
        torch.full((FRAMES, 48, 64, 3), 90, dtype=torch.uint8),
        panned(STILL)[:1],
    ],
    ids=["nothing moves", "a large arm", "a plain wall", "changing light", "no texture", "one frame"],
)
def test_a_camera_that_stands_is_known_whatever_moves_before_it(rgb: torch.Tensor) -> None:
    assert is_steady(camera_stands(rgb))


@pytest.mark.parametrize("step_px", [3.0, 6.0, 12.0])
def test_a_step_is_found_where_it_is(step_px: float) -> None:
    found = camera_stands(panned(along((12, 0), (1, step_px), (11, 0)), arm=lambda t: (40 + t, 70 + t)))
    assert [(stand.start, stand.end, stand.path) for stand in found.stands] == [(0, 12, None), (12, FRAMES, None)]
    assert found.steps_px == pytest.approx([2 * step_px], abs=0.4)  # the picture is half as wide as px are told for
    assert not found.moves
    assert found.entry()["moved"] == [{"frame": 12, "px": pytest.approx(2 * step_px, abs=0.4)}]


def test_a_drift_is_followed_frame_by_frame() -> None:
    shifts = along((FRAMES, 0.4))
    (stand,) = camera_stands(panned(shifts, arm=sweeping)).stands
    assert stand.drift_px == pytest.approx(0.8 * FRAMES, abs=3)
    assert stand.path is not None
    assert stand.path.affines[:, 0, 2] == pytest.approx(-(shifts[:, 0] - shifts[FRAMES // 2, 0]), abs=0.6)


@pytest.mark.parametrize("gripper", [False, True])
def test_a_camera_that_rides_on_the_arm_moves(gripper: bool) -> None:
    angle = np.arange(2 * FRAMES) / 6
    shifts = np.stack((60 * np.sin(angle), 25 * np.sin(0.7 * angle)), axis=1)
    found = camera_stands(panned(shifts, gripper=gripper))
    assert found.moves
    assert "does not stand still" in found.reason()
    assert not found.entry()["stands"]


def test_the_path_comes_back_to_the_first_frame() -> None:
    away = distances_px(camera_path(panned(along((6, 0), (8, 1.0), (4, 0), (8, -1.0), (4, 0)))))
    assert away[[0, 14, 29]] == pytest.approx([0, 16, 0], abs=0.3)


def test_two_pictures_of_one_wall() -> None:
    first, second, other = panned(np.array([[0, 0], [15.0, 0], [150.0, 90]]))
    assert displacement_px(first, second) == pytest.approx(30, abs=0.4)
    assert displacement_px(first, torch.full_like(other, 90)) is None
