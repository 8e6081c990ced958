"""Evenly spread frames, and lengths in pixels at any size."""

import numpy as np
import pytest

from lerobot_msdyn.core.sampling import evenly, scaled_px, scaled_window


@pytest.mark.parametrize(("total", "most"), [(1, 5), (5, 5), (7, 3), (135, 60), (3000, 40)])
def test_numbers_are_spread_from_the_first_to_the_last(total: int, most: int) -> None:
    numbers = evenly(total, most).tolist()
    assert len(numbers) == len(set(numbers)) == min(total, most)
    assert numbers[0] == 0
    assert most == 1 or numbers[-1] == total - 1
    steps = np.diff(numbers)
    assert len(steps) == 0 or steps.max() - steps.min() <= 1


def test_lengths_are_those_of_a_picture_320_wide() -> None:
    assert scaled_px(3, 320) == 3
    assert scaled_px(3, 640) == 6
    assert scaled_px(0.5, 160) == 0.25


@pytest.mark.parametrize(("px", "width", "side"), [(2, 320, 5), (2, 640, 9), (2, 160, 3), (2, 64, 3), (0, 640, 1)])
def test_a_window_reaches_at_least_a_pixel(px: int, width: int, side: int) -> None:
    window = scaled_window(px, width)
    assert window.shape == (side, side)
    assert window.dtype == np.uint8
    assert window.all()
