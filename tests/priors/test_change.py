"""Change against noise and shadow."""

import numpy as np
import pytest

from lerobot_msdyn.priors.masks.change import Colours, Reference, along_edges

NOISE = np.ones((72, 96), np.float32)


@pytest.fixture
def ground(sliding) -> np.ndarray:
    return sliding.empty.round().astype(np.uint8)


def test_noise_is_no_change(ground) -> None:
    noise = np.random.default_rng(0).normal(size=ground.shape) * 2
    odds = Reference(ground, NOISE).change(np.clip(ground + noise, 0, 255).astype(np.uint8))
    assert (odds < 0).all()


def test_another_colour_is_a_change(ground) -> None:
    frame = ground.copy()
    frame[20:40, 30:60] = (200, 60, 40)
    odds = Reference(ground, NOISE).change(frame)
    assert (odds[20:40, 30:60] > 0).all()
    assert (odds[:14] < 0).all()
    assert (odds[:, 67:] < 0).all()
    assert np.abs(odds).max() <= 6


def test_a_shadow_is_no_change(ground) -> None:
    frame = ground.copy()
    frame[20:50, 30:70] = (0.6 * frame[20:50, 30:70]).astype(np.uint8)
    odds = Reference(ground, NOISE).change(frame)
    assert (odds > 0).mean() < 0.02


def test_odds_follow_the_edges_of_the_picture(ground) -> None:
    """A mask that is 2 px too large shrinks towards the thing in the picture; a speck beside it goes."""
    frame = ground.copy()
    frame[20:44, 30:60] = (230, 40, 200)
    odds = np.full(NOISE.shape, -3, np.float32)
    odds[18:46, 28:62] = 3
    odds[5, 5] = 6
    truth = np.zeros(NOISE.shape, bool)
    truth[20:44, 30:60] = True
    sharper = along_edges(odds, frame) > 0
    assert (sharper ^ truth).sum() < 0.7 * ((odds > 0) ^ truth).sum()
    assert not sharper[5, 5]


def test_colours_of_what_moves_are_learnt(ground) -> None:
    frame = ground.copy()
    frame[20:40, 30:60] = (200, 60, 40)
    colours = Colours()
    sure = np.full(NOISE.shape, -5, np.float32)
    sure[20:40, 30:60] = 5
    colours.add(frame, sure, 3.0)
    elsewhere = ground.copy()
    elsewhere[50:60, 10:20] = (200, 60, 40)
    odds = colours.odds(elsewhere)
    assert (odds[50:60, 10:20] > 2).all()
    assert (odds[:45] < 0).mean() > 0.95


def test_colours_that_were_never_met_tell_nothing(ground) -> None:
    assert (Colours().odds(ground) == 0).all()
