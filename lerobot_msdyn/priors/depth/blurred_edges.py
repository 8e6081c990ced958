"""Depth edges that a network or a filter has blurred, made sharp again: nothing floats between two surfaces."""

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

JUMP = 0.03  # relative difference of depth across an edge
NARROW = 1.5  # on a slope, a window of twice the reach spans twice the inverse depth; at an edge, less than this
BETWEEN = 0.05  # share of the jump by which a pixel must be off both surfaces
REACH_PX = 2  # of a blurred edge to either side
UNKNOWN = 1e9  # larger than any inverse depth


def sharpened(depth: Float[Tensor, "t h w"]) -> Float[Tensor, "t h w"]:
    """Depth (m, 0 = unknown) in which pixels between two surfaces, a few pixels from both, are put on the nearer one.

    Nearer is meant in inverse depth. Slopes are left alone, and so is depth whose edges are sharp.
    """
    return torch.from_numpy(np.stack([_sharpened(frame) for frame in depth.numpy()]))


def _sharpened(z: np.ndarray) -> np.ndarray:
    known = z > 0
    inverse = np.where(known, 1 / np.maximum(z, np.float32(1e-6)), np.float32(0))
    near, far, jump = _span(inverse, known, REACH_PX)
    wide_jump = _span(inverse, known, 2 * REACH_PX)[2]
    nearness = (inverse - far) / np.maximum(jump, 1e-9)
    edge = known & (jump > JUMP * far) & (wide_jump < NARROW * jump) & (nearness > BETWEEN) & (nearness < 1 - BETWEEN)
    inside = np.zeros_like(known)  # at the border of the image a slope cannot be told from an edge
    inside[2 * REACH_PX : -2 * REACH_PX, 2 * REACH_PX : -2 * REACH_PX] = True
    edge &= inside
    return np.where(edge, 1 / np.where(nearness > 0.5, near, far).clip(1e-6), z).astype(np.float32)


def _span(inverse: np.ndarray, known: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Largest and smallest known inverse depth within some pixels, and their difference."""
    window = np.ones((2 * reach + 1,) * 2, np.uint8)
    near = cv2.dilate(inverse, window)
    far = cv2.erode(np.where(known, inverse, np.float32(UNKNOWN)), window)
    far = np.where(far < UNKNOWN, far, near)
    return near, far, near - far
