import numpy as np

from lerobot_msdyn.priors.medians import median_where


def test_median_is_over_the_usable_frames_of_the_region():
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (9, 6, 8, 3), dtype=np.uint8)
    usable = rng.random((9, 6, 8)) < 0.5
    usable[:, 0, 0] = False
    where = np.ones((6, 8), bool)
    where[:, 7] = False
    otherwise = np.full((6, 8, 3), 7, np.uint8)
    found = median_where(frames, usable, where, otherwise)
    for y, x in np.argwhere(where & usable.any(0)):
        assert (found[y, x] == np.median(frames[usable[:, y, x], y, x], axis=0).round()).all()
    assert (found[0, 0] == 7).all()
    assert (found[:, 7] == 7).all()
