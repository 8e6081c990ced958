"""Things that rested in the picture of the empty scene."""

import numpy as np

from lerobot_msdyn.priors.masks.ghosts import median_where, without_ghosts

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


def test_the_median_is_taken_over_the_usable_frames_of_the_region() -> None:
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
