"""Things that rested in the picture of the empty scene."""

import numpy as np

from lerobot_msdyn.priors.masks.ghosts import without_ghosts

FRAMES = 20


def clip(sliding, *, leaves: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A block that leaves at frame 8, or comes then; what seems covered; the picture of the empty scene; its place."""
    ground = sliding.empty.round().astype(np.uint8)
    there = ground.copy()
    place = np.zeros(ground.shape[:2], bool)
    place[24:44, 30:60] = True
    there[place] = (200, 60, 40)
    frames = np.stack([ground] * FRAMES if leaves else [there] * FRAMES)
    frames[:8] = there if leaves else ground
    moving = np.zeros((FRAMES, *place.shape), bool)
    moving[8:, place] = True
    return frames, moving, there if leaves else ground, place


def test_ground_that_was_left_bare_is_put_back(sliding) -> None:
    frames, moving, empty, place = clip(sliding, leaves=True)
    mended, changed = without_ghosts(frames, moving, empty, stride=1.0)
    np.testing.assert_array_equal(changed, place)
    np.testing.assert_array_equal(mended, frames[-1])


def test_a_thing_that_came_to_rest_stays_a_thing(sliding) -> None:
    frames, moving, empty, _ = clip(sliding, leaves=False)
    mended, changed = without_ghosts(frames, moving, empty, stride=1.0)
    assert not changed.any()
    np.testing.assert_array_equal(mended, empty)


def test_what_keeps_moving_is_no_ghost(sliding) -> None:
    rgb, mask = sliding.rgb.numpy()[8:20], sliding.mask.numpy()[8:20]
    _, changed = without_ghosts(rgb, mask, sliding.empty.round().astype(np.uint8), stride=1.0)
    assert not changed.any()
