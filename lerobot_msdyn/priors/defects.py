"""Frames that do not show what was going on: blank, frozen, of another moment; and steps of the exposure.

All measures are relative to the video's own.
"""

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.observations import View

WIDTH_PX = 160  # at which pictures are compared
BLANK = 0.05  # of the contrast that the video usually has, under which a frame shows nothing
FLAT_GREY_LEVELS = 1.0  # a video whose contrast is less shows nothing at all
USUAL = 0.8  # quantile that stands for what is usual, also where many frames are defective
SAME = 0.05  # of the usual change where the state moves, under which a picture repeats the one before
MOVES = 0.25  # of the usual speed of the state, over which it moves
REPEATS = 3  # in a row, at least, that count as frozen; a slow camera repeats single pictures
STRAY = 1.5  # times the largest usual change from picture to picture, by which a stray first picture differs at least
BELONGS = 0.5  # of that difference, under which it belongs to the episode before
STEP = 0.06  # logarithm of the gain from one frame to the next that is a step, ...
STEP_RATIO = 6.0  # ... and times the usual one
EVEN = 0.5  # share of the pixels that must change alike
DARK_GREY_LEVELS = 4.0  # added to both sides of a ratio; a pixel that is darker has none that tells


@dataclass(frozen=True)
class Defects:
    """What is wrong with the pictures of one camera; frames count from the episode's start."""

    frames: int  # of the episode
    blank: tuple[int, ...] = ()
    frozen: tuple[tuple[int, int], ...] = ()  # first and last frame that repeat the one before, while the state moves
    stray_start: bool = False  # frame 0 belongs to the episode before
    exposure_steps: tuple[tuple[int, float], ...] = ()  # first frame with the new exposure, factor of the brightness

    @property
    def unusable(self) -> tuple[int, ...]:
        """Frames that nothing may be fitted to."""
        return tuple(sorted({*self.blank, *([0] if self.stray_start else [])}))

    def lines(self) -> list[str]:
        """Each kind in words, with the numbers of its frames."""
        found = []
        if self.blank:
            found.append(f"blank: {_frames(_runs(self.blank))} (not fitted; new views show the nearest other frame)")
        if self.stray_start:
            found.append("frame 0 belongs to the episode before (not fitted; new views show frame 1)")
        if self.frozen:
            found.append(f"frozen while the state moves: {_frames(self.frozen)} (used as they are)")
        if self.exposure_steps:
            steps = ", ".join(f"{frame} (x{factor:.2f})" for frame, factor in self.exposure_steps)
            found.append(f"exposure changes at frame {steps} (fitted as a change of brightness)")
        return found


def find_defects(
    rgb: UInt8[Tensor, "t h w 3"], state: Float[Tensor, "t s"] | None, before: UInt8[Tensor, "1 h w 3"] | None = None
) -> Defects:
    """Look at all pictures of one camera.

    Args:
        rgb: the video.
        state: that of the robot at the same times; without it nothing tells frozen pictures from a still scene.
        before: the last picture of the episode before.
    """
    small = _small(rgb)
    contrast = np.array([cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).std() for picture in small])
    usual = float(np.quantile(contrast, USUAL))
    blank = contrast < max(BLANK * usual, FLAT_GREY_LEVELS)
    shown = np.flatnonzero(~blank)
    if len(shown) < 2:
        return Defects(len(rgb), tuple(np.flatnonzero(blank).tolist()))
    gain, even = _gains(small[shown])
    speed = None if state is None else _speed(state.numpy()[shown])
    return Defects(
        len(rgb),
        tuple(np.flatnonzero(blank).tolist()),
        () if speed is None else _frozen(small[shown], speed, shown),
        before is not None and bool(shown[0] == 0) and _stray_start(small[shown], _small(before)[0]),
        tuple((int(shown[i + 1]), float(np.exp(gain[i]))) for i in _steps(gain, even)),
    )


def repaired(view: View, defects: Defects) -> View:
    """The video with the nearest usable frame, and its camera, in place of each unusable one."""
    if not defects.unusable:
        return view
    usable = torch.tensor([frame for frame in range(len(view)) if frame not in defects.unusable])
    distance = (torch.arange(len(view))[:, None] - usable).abs()
    return view.select(usable[distance.argmin(1)])


def _small(rgb: UInt8[Tensor, "t h w 3"]) -> UInt8[ndarray, "t a b 3"]:
    """Pictures at the size at which they are compared."""
    height, width = rgb.shape[1:3]
    size = (min(width, WIDTH_PX), max(1, round(height * min(width, WIDTH_PX) / width)))
    return np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in rgb.numpy()])


def _gains(small: UInt8[ndarray, "t a b 3"]) -> tuple[Float[ndarray, " d"], Bool[ndarray, " d"]]:
    """Logarithm of the gain from each frame to the next, and whether most of the picture changes by it."""
    gains, even = [], []
    for before, after in itertools.pairwise(small):
        ratio = np.log((after.mean(-1) + DARK_GREY_LEVELS) / (before.mean(-1) + DARK_GREY_LEVELS))
        gains.append(float(np.median(ratio)))
        even.append(float(np.mean(np.abs(ratio - gains[-1]) < EVEN * abs(gains[-1]))) > EVEN)
    return np.array(gains), np.array(even)


def _steps(gain: Float[ndarray, " d"], even: Bool[ndarray, " d"]) -> list[int]:
    least = max(STEP, STEP_RATIO * float(np.median(np.abs(gain))))
    return np.flatnonzero((np.abs(gain) > least) & even).tolist()


def _speed(state: Float32[ndarray, "t s"]) -> Float[ndarray, " d"]:
    """Change of the state from each frame to the next, every dimension in units of its spread."""
    spread = state.std(0)
    moving = spread > 1e-6
    return np.linalg.norm(np.diff(state[:, moving] / spread[moving], axis=0), axis=1)


def _frozen(
    small: UInt8[ndarray, "t a b 3"], speed: Float[ndarray, " d"], shown: Int[ndarray, " t"]
) -> tuple[tuple[int, int], ...]:
    """Runs of pictures that repeat the one before while the state moves."""
    # Motion is strong in few pixels, what a codec changes in a still picture is weak everywhere.
    change = np.array([np.percentile(cv2.absdiff(a, b).max(-1), 99) for a, b in itertools.pairwise(small)])
    usual_speed = float(np.quantile(speed, USUAL))
    moves = speed > MOVES * usual_speed
    if usual_speed <= 0 or not moves.any():
        return ()
    same = (change < SAME * float(np.quantile(change[moves], USUAL))) & moves
    runs = _runs(np.flatnonzero(same).tolist())
    return tuple((int(shown[low + 1]), int(shown[high + 1])) for low, high in runs if high - low + 1 >= REPEATS)


def _stray_start(small: UInt8[ndarray, "t a b 3"], before: UInt8[ndarray, "a b 3"]) -> bool:
    """Whether the first picture jumps to the second as no other does, and is near the last of the episode before."""
    if len(small) < 2 + REPEATS:
        return False
    jump, *changes = [_difference(a, b) for a, b in itertools.pairwise(small)]
    return jump > STRAY * float(np.quantile(changes, 0.95)) and _difference(before, small[0]) < BELONGS * jump


def _difference(before: UInt8[ndarray, "a b 3"], after: UInt8[ndarray, "a b 3"]) -> float:
    """Of two pictures, beside a change of the exposure."""
    lit = before.mean(-1) > DARK_GREY_LEVELS
    gain = float(np.median(after.mean(-1)[lit] / before.mean(-1)[lit])) if lit.any() else 1.0
    return float(np.abs((gain * before).clip(0, 255) - after).mean())


def _runs(numbers: tuple[int, ...] | list[int]) -> tuple[tuple[int, int], ...]:
    """Runs of rising numbers, by their ends."""
    runs: list[tuple[int, int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1] = (runs[-1][0], number)
        else:
            runs.append((number, number))
    return tuple(runs)


def _frames(runs: tuple[tuple[int, int], ...]) -> str:
    """Runs in words."""
    listed = ", ".join(str(low) if low == high else f"{low} to {high}" for low, high in runs)
    return f"frame {listed}" if len(runs) == 1 and runs[0][0] == runs[0][1] else f"frames {listed}"
