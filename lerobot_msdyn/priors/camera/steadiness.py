"""How much a camera moves during a clip, by the features of its pictures."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.corners import FEWEST, away_from, corners_followed
from lerobot_msdyn.core.sampling import evenly

FIXED_PX = 0.5  # of 320: a camera whose picture moves less is fixed
SWAY_PX = 3.0  # of 320: up to this it is taken as fixed; the masks allow for such a sway
_PAIRS = 20  # pairs of frames that are looked at, evenly spread


def camera_motion_px(rgb: UInt8[Tensor, "t h w 3"], moving: Bool[Tensor, "t h w"] | None = None) -> float:
    """Median motion (px) of the picture's features over a twentieth of the clip; features on `moving` do not count.

    Where too few features can be followed, phase correlation of the whole pictures decides.
    """
    frames = evenly(len(rgb), _PAIRS + 1).numpy()
    grey = [cv2.cvtColor(rgb[int(frame)].numpy(), cv2.COLOR_RGB2GRAY) for frame in frames]
    masks = [_usable(moving, int(frame), grey[0].shape) for frame in frames]
    motions = [_motion_px(grey[i], grey[i + 1], masks[i]) for i in range(len(frames) - 1)]
    return float(np.median(motions)) if motions else 0.0


def _usable(moving: Bool[Tensor, "t h w"] | None, frame: int, shape: tuple[int, ...]) -> UInt8[ndarray, "h w"]:
    """255 where corners may be taken: what moves, and a band around it, is left out."""
    if moving is None:
        return np.full(shape, 255, np.uint8)
    return away_from(moving[frame].numpy())


def _motion_px(a: UInt8[ndarray, "h w"], b: UInt8[ndarray, "h w"], usable: UInt8[ndarray, "h w"]) -> float:
    corners, there = corners_followed(a, b, usable)
    if len(corners) >= FEWEST:
        return float(np.median(np.linalg.norm(there - corners, axis=-1)))
    pair: list[Float32[ndarray, "h w"]] = [np.where(usable > 0, image, 0).astype(np.float32) for image in (a, b)]
    window = cv2.createHanningWindow(a.shape[::-1], cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(pair[0], pair[1], window)
    return float(np.hypot(*shift))
