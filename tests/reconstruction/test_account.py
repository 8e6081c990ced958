"""The account of what renders what moves: pooled by pixels, kept as plain values, and said in words."""

import json
import math

import pytest

from lerobot_msdyn.reconstruction.account import Account, account_line, account_sentence, decibels, pooled
from lerobot_msdyn.scene.sources import MovingPixels

MOSTLY_MOTION = Account(MovingPixels(80, 5, 10, 5), 1e-3, 4e-3, held_out=True)
MOSTLY_OVERLAY = Account(MovingPixels(30, 60, 210, 0), 2e-3, 2e-2, held_out=False)
NOTHING = Account(MovingPixels(), 0.0, 0.0, held_out=True)


def test_decibels() -> None:
    assert decibels(0.01) == pytest.approx(20)
    assert decibels(0.0) == 60
    assert math.isnan(NOTHING.dynamic_db)


def test_every_moving_pixel_counts_alike() -> None:
    both = pooled([MOSTLY_MOTION, NOTHING, MOSTLY_OVERLAY])
    assert both.pixels == MovingPixels(110, 65, 220, 5)
    assert both.error == pytest.approx((100 * 1e-3 + 300 * 2e-3) / 400)
    assert both.error_by_motion == pytest.approx((100 * 4e-3 + 300 * 2e-2) / 400)
    assert not both.held_out
    assert pooled([NOTHING, NOTHING]) == NOTHING


@pytest.mark.parametrize("account", [MOSTLY_MOTION, MOSTLY_OVERLAY, NOTHING])
def test_its_entry_is_plain_and_can_be_read_back(account: Account) -> None:
    entry = json.loads(json.dumps(account.entry(), allow_nan=False))
    again = Account.from_entry(entry)
    assert again.pixels == account.pixels
    assert again.held_out == account.held_out
    assert again.error == pytest.approx(account.error, rel=2e-3)
    assert again.error_by_motion == pytest.approx(account.error_by_motion, rel=2e-3)


def test_it_is_said_in_words() -> None:
    assert account_line(MOSTLY_OVERLAY) == (
        "what moves: 10 % of its pixels rendered by motion, 20 % by short-lived Gaussians, 70 % by overlay (recorded "
        "pixels); dynamic PSNR 27.0 dB, 17.0 by motion alone"
    )
    line, sentence = account_line(MOSTLY_MOTION), account_sentence(MOSTLY_MOTION)
    assert "5 % by short-lived Gaussians, 10 % by overlay (recorded pixels), 5 % by the background; " in line
    assert "80 % are rendered by motion, 5 % are recorded pixels carried over a few frames" in sentence
    assert "on held-out frames of the recorded view, PSNR is 30.0 dB, and 24.0 dB" in sentence
    assert "on a few frames" in account_sentence(MOSTLY_OVERLAY)
    assert "nothing" in account_line(NOTHING)
    assert "nothing" in account_sentence(NOTHING)
