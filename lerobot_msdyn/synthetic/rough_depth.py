"""True depth made into what a monocular network would give."""

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

BIAS = 0.03  # relative, smooth over the picture, the same in all frames
FRAME_BIAS, FRAME_SCALE = 0.005, 0.01  # the same per frame, and of all of a frame
NEAREST_M = 0.05


def rough_depth(
    depth: Float[ndarray, "t h w"], rng: np.random.Generator, worse: float = 1.0
) -> Float[ndarray, "t h w"]:
    """Depth (m) with blurred edges, a bias that stays, one that changes from frame to frame, and flicker.

    All but the edges `worse` times as much as a network errs.
    """
    height, width = depth.shape[1:]

    def smooth(sigma: float) -> ndarray:
        coarse = rng.normal(0, sigma, (6, 8)).astype(np.float32)
        return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)

    bias = smooth(worse * BIAS)
    found = np.zeros_like(depth)
    for frame, true in enumerate(depth):
        inverse = cv2.resize(1 / np.maximum(true, NEAREST_M), (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        inverse = cv2.resize(inverse, (width, height), interpolation=cv2.INTER_LINEAR)
        found[frame] = 1 / (inverse * np.exp(bias + smooth(worse * FRAME_BIAS) + rng.normal(0, worse * FRAME_SCALE)))
    return found
