"""Colours of one camera as another shows them: colours where they differ, and no help to a picture that is wrong."""

import numpy as np
import pytest

from lerobot_msdyn.evaluate.colour import fit_colours
from lerobot_msdyn.evaluate.metrics import masked_psnr_db

SIZE = (3, 40, 50)


def pictures(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(20, 200, (*SIZE, 3)).astype(np.uint8)


def test_exposure_and_white_balance_are_found() -> None:
    rendered, masks = pictures(0), np.ones(SIZE, bool)
    masks[:, :, 25:] = False
    true = (rendered * np.array([0.8, 1.0, 1.1]) + np.array([20, 5, -3])).clip(0, 255).astype(np.uint8)
    true[:, :, 25:] = 0  # outside the masks nothing counts
    colours = fit_colours(rendered, true, masks)
    assert colours.gain == pytest.approx([0.8, 1.0, 1.1], abs=0.01)
    difference = np.abs(colours.apply(rendered).astype(int) - true)[masks]
    assert difference.max() <= 2


def test_a_wrong_picture_is_not_made_flat() -> None:
    """Least squares would turn a picture that agrees with nothing into the mean colour, which scores better."""
    rendered, true, masks = pictures(1), pictures(2), np.ones(SIZE, bool)
    colours = fit_colours(rendered, true, masks)
    assert colours.gain == pytest.approx(np.ones(3), abs=0.05)
    flat = np.broadcast_to(true.mean((0, 1, 2)).astype(np.uint8), true.shape)
    mapped = masked_psnr_db(colours.apply(rendered)[0], true[0], masks[0])
    assert mapped == pytest.approx(masked_psnr_db(rendered[0], true[0], masks[0]), abs=0.3)
    assert mapped < masked_psnr_db(np.ascontiguousarray(flat[0]), true[0], masks[0]) - 2


def test_nothing_to_fit_to_leaves_the_colours() -> None:
    rendered = pictures(3)
    assert (fit_colours(rendered, rendered, np.zeros(SIZE, bool)).apply(rendered) == rendered).all()
