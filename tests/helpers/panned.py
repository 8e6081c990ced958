"""Videos of a camera whose way over a textured wall is known, with an arm or a gripper before it."""

from collections.abc import Callable

import cv2
import numpy as np
import torch
from sliding import texture
from torch import Tensor

HEIGHT, WIDTH = 120, 160
WALL = texture(360, 520, 0, (120, 120, 110))
ARM = texture(HEIGHT, WIDTH, 9, (200, 160, 60))


def panned(
    shifts: np.ndarray,
    *,
    contrast: float = 1.0,
    arm: Callable[[int], tuple[int, int]] | None = None,
    gripper: bool = False,
    gain: Callable[[int], float] = lambda t: 1.0,
    noise: float = 1.5,
) -> Tensor:
    """The wall, shifted by [t,2] px.

    Args:
        shifts: x, y of each frame.
        contrast: of the wall.
        arm: the first and last column that an arm covers, from top to bottom, by frame; its texture moves with it.
        gripper: whether the lower middle of the picture, a sixth of it, never changes.
        gain: brightness by frame.
        noise: standard deviation, grey levels.
    """
    generator = np.random.default_rng(5)
    wall = WALL.mean((0, 1)) + contrast * (WALL - WALL.mean((0, 1)))
    pictures = []
    for t, (x, y) in enumerate(shifts):
        place = np.array([[1, 0, -180 - x], [0, 1, -120 - y]], np.float32)
        picture = cv2.warpAffine(wall.astype(np.float32), place, (WIDTH, HEIGHT))
        if arm is not None:
            first, last = arm(t)
            picture[:, max(first, 0) : max(last, 0)] = np.roll(ARM, first, axis=1)[:, max(first, 0) : max(last, 0)]
        if gripper:
            picture[60:, 50:103] = ARM[60:, 50:103]
        pictures.append(np.clip(gain(t) * picture + noise * generator.normal(size=picture.shape), 0, 255))
    return torch.from_numpy(np.stack(pictures).round().astype(np.uint8))


def along(*ways: tuple[int, float]) -> np.ndarray:
    """Shifts [t,2] to the right: (frames, px per frame) after each other."""
    speed = np.concatenate([np.full(frames, px) for frames, px in ways])
    return np.stack((speed.cumsum(), np.zeros(len(speed))), axis=1)
