"""Numbers of moving things."""

import numpy as np

from lerobot_msdyn.priors.masks.linking import MAX_INSTANCES, numbered


def test_the_largest_thing_is_number_one(sliding) -> None:
    frames, moving = sliding.rgb.numpy(), sliding.mask.numpy().copy()
    moving[:, 60:70, 80:90] = True
    numbers = numbered(frames, moving)
    assert (numbers[sliding.mask.numpy()] == 1).all()
    assert (numbers[:, 60:70, 80:90] == 2).all()
    assert ((numbers > 0) == moving).all()


def test_what_is_short_lived_or_too_much_is_dropped(sliding) -> None:
    frames, moving = sliding.rgb.numpy(), np.zeros((30, 72, 96), bool)
    for k in range(MAX_INSTANCES + 2):
        moving[:, 4:10, 9 * k + 2 : 9 * k + 8] = True
    moving[3:5, 40:60, 40:60] = True
    numbers = numbered(frames, moving)
    assert numbers.max() == MAX_INSTANCES
    assert not numbers[:, 40:60].any()
