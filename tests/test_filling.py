"""What stands where nobody has seen anything."""

import numpy as np

from lerobot_msdyn.filling import fill_holes


def test_holes_are_filled_from_their_borders_and_counted() -> None:
    rgb = np.full((20, 20, 3), 100, np.uint8)
    alpha = np.ones((20, 20), np.float32)
    rgb[5:9, 5:9], alpha[5:9, 5:9] = 0, 0.1
    filled, share = fill_holes(rgb, alpha)
    assert share == 16 / 400
    assert (np.abs(filled.astype(int) - 100) <= 2).all()


def test_a_whole_picture_stays_as_it_is() -> None:
    rgb = np.random.default_rng(0).integers(0, 255, (8, 8, 3), np.uint8)
    for alpha in (np.ones((8, 8), np.float32), np.zeros((8, 8), np.float32)):
        filled, share = fill_holes(rgb, alpha)
        assert np.array_equal(filled, rgb)
        assert share == 1 - alpha[0, 0]
