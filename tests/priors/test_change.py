"""Change against noise and shadow."""

import numpy as np
import pytest


@pytest.fixture
def ground(sliding) -> np.ndarray:
    return sliding.empty.round().astype(np.uint8)


NOISE = np.ones((72, 96), np.float32)


def changed(frame: np.ndarray, ground: np.ndarray) -> np.ndarray:
    from lerobot_msdyn.priors.change import changes

    return changes(frame[None], ground, NOISE)[0]


def test_noise_is_no_change(ground) -> None:
    noise = np.random.default_rng(0).normal(size=ground.shape) * 2
    assert not changed(np.clip(ground + noise, 0, 255).astype(np.uint8), ground).any()


def test_another_colour_is_a_change(ground) -> None:
    frame = ground.copy()
    frame[20:40, 30:60] = (200, 60, 40)
    found = changed(frame, ground)
    assert found[22:38, 32:58].all()
    assert not found[:18].any()
    assert not found[:, 63:].any()


def test_a_shadow_is_no_change(ground) -> None:
    frame = ground.copy()
    frame[20:50, 30:70] = (0.7 * frame[20:50, 30:70]).astype(np.uint8)
    found = changed(frame, ground)
    assert found[23:47, 33:67].mean() < 0.02


def test_a_faint_spot_without_a_sure_core_is_no_change(ground) -> None:
    frame = ground.copy().astype(int)
    frame[20:40, 30:60] += (6, -6, 6)
    assert not changed(frame.clip(0, 255).astype(np.uint8), ground).any()
