"""Votes of point tracks."""

import numpy as np

from lerobot_msdyn.priors.masks.votes import votes


def test_tracks_tell_a_resting_block_from_its_ground(sliding) -> None:
    for_moving, for_empty = votes(sliding.rgb.numpy(), np.ones((72, 96), bool))
    for frame in (2, 28):  # before it starts, and after it has come to rest
        block = sliding.mask[frame].numpy()
        assert (for_moving > for_empty)[frame][block].mean() > 0.6  # votes reach across edges
        assert (for_moving > for_empty)[frame][~block].mean() < 0.2


def test_nobody_votes_outside_the_region(sliding) -> None:
    region = np.zeros((72, 96), bool)
    region[:, :30] = True
    for_moving, for_empty = votes(sliding.rgb.numpy(), region)
    assert not (for_moving + for_empty)[:, :, 50:].any()
