"""Who renders what moves: motion, or recorded pixels; and how far off each is, over the frames of the self-check.

A moving pixel is one of the recorded camera that the masks call moving; `scene.sources` says what renders it. Dynamic
PSNR is the PSNR over these pixels. Patches (short-lived Gaussians, overlay) are made from all frames, the checked ones
too: with them, recorded pixels are compared with themselves, so that only the PSNR by motion alone tells how well
motion is understood. What patches are worth from elsewhere is measured by held-out cameras (`python -m
lerobot_msdyn.evaluate nvs`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_msdyn.scene.sources import MovingPixels

NAMED_FROM = 0.005  # share of moving pixels that the background renders, from which on it is mentioned


def decibels(error: float) -> float:
    """Peak signal-to-noise ratio (dB) of a mean square error of colours 0..1; at most 60."""
    return float(-10 * np.log10(max(error, 1e-6)))


@dataclass(frozen=True)
class Account:
    """What renders the moving pixels of some frames of the recorded camera, and their colour error."""

    pixels: MovingPixels
    error: float  # mean square over the moving pixels, colours 0..1, as new views are rendered; 0 where nothing moves
    error_by_motion: float  # the same by motion and background alone
    held_out: bool  # whether the fit never saw these frames

    @property
    def dynamic_db(self) -> float:
        """Dynamic PSNR; NaN where nothing moves."""
        return decibels(self.error) if self.pixels.total > 0 else math.nan

    @property
    def dynamic_by_motion_db(self) -> float:
        """The same by motion and background alone."""
        return decibels(self.error_by_motion) if self.pixels.total > 0 else math.nan

    def entry(self) -> dict[str, Any]:
        """For files: plain values, rounded; no dynamic PSNR (null) where nothing moves."""
        moves = self.pixels.total > 0
        return {
            "pixels": self.pixels.total,
            **{name: round(share, 4) for name, share in self.pixels.shares.items()},
            "dynamic_db": round(self.dynamic_db, 2) if moves else None,
            "dynamic_by_motion_db": round(self.dynamic_by_motion_db, 2) if moves else None,
            "held_out": self.held_out,
        }

    @staticmethod
    def from_entry(entry: dict[str, Any]) -> "Account":
        """The account that an `entry` was made of, up to rounding."""
        shares = (entry[name] for name in MovingPixels().shares)
        pixels = MovingPixels(*(round(entry["pixels"] * share) for share in shares))
        shown, alone = (
            0.0 if db is None else 10 ** (-db / 10) for db in (entry["dynamic_db"], entry["dynamic_by_motion_db"])
        )
        return Account(pixels, shown, alone, entry["held_out"])


def pooled(accounts: Sequence[Account]) -> Account:
    """Several windows, cameras or episodes as one: every moving pixel counts alike."""
    pixels = sum((account.pixels for account in accounts), MovingPixels())
    counts = [account.pixels.total for account in accounts]

    def mean(errors: list[float]) -> float:
        return float(np.average(errors, weights=counts)) if pixels.total > 0 else 0.0

    return Account(
        pixels,
        mean([account.error for account in accounts]),
        mean([account.error_by_motion for account in accounts]),
        all(account.held_out for account in accounts),
    )


def account_line(account: Account) -> str:
    """An account in one line, for logs and terminals."""
    if account.pixels.total == 0:
        return "what moves: nothing, in the frames that were checked"
    motion, lasting, overlay, background = (f"{100 * share:.0f} %" for share in account.pixels.shares.values())
    missed = f", {background} by the background" if account.pixels.shares["by_background"] >= NAMED_FROM else ""
    return (
        f"what moves: {motion} of its pixels rendered by motion, {lasting} by short-lived Gaussians, {overlay} by "
        f"overlay (recorded pixels){missed}; "
        f"dynamic PSNR {account.dynamic_db:.1f} dB, {account.dynamic_by_motion_db:.1f} by motion alone"
    )


def account_sentence(account: Account) -> str:
    """An account in words, for readers who know none of its terms."""
    if account.pixels.total == 0:
        return "nothing moves in the frames that were checked."
    motion, lasting, overlay, background = (f"{100 * share:.0f} %" for share in account.pixels.shares.values())
    frames = "held-out frames" if account.held_out else "a few frames"
    return (
        f"of the pixels that show something moving, {motion} are rendered by motion, {lasting} are recorded pixels "
        f"carried over a few frames (short-lived), {overlay} are shown at their own frame alone (overlay), and "
        f"{background} show the background. Over them, on {frames} of the recorded view, PSNR is "
        f"{account.dynamic_db:.1f} dB, and {account.dynamic_by_motion_db:.1f} dB by motion alone: the latter tells how "
        "well motion is understood."
    )
