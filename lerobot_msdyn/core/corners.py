"""Corners of a picture, and where they are in another."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

MOST = 300
FEWEST = 12  # with fewer there are none
RETURN_PX = 0.5  # difference of a corner to itself, followed there and back
MARGIN_PX = 4  # about what moves, in which none is taken


def corners_followed(
    a: UInt8[ndarray, "h w"], b: UInt8[ndarray, "h w"], usable: UInt8[ndarray, "h w"] | None = None
) -> tuple[Float32[ndarray, "n 2"], Float32[ndarray, "n 2"]]:
    """Corners of a grey picture and their places in another (px, the first pixel's centre at 0), if they lead back.

    Only those where `usable` is 255, if it is given.
    """
    corners = cv2.goodFeaturesToTrack(a, MOST, 0.01, 7, mask=usable)
    if corners is None or len(corners) < FEWEST:
        return np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32)
    there, followed, _ = cv2.calcOpticalFlowPyrLK(a, b, corners, None, winSize=(21, 21), maxLevel=4)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(b, a, there, None, winSize=(21, 21), maxLevel=4)
    good = (followed[:, 0] > 0) & (returned[:, 0] > 0) & (np.linalg.norm(back - corners, axis=-1)[:, 0] < RETURN_PX)
    return corners[good, 0], there[good, 0]


def away_from(moving: Bool[ndarray, "h w"]) -> UInt8[ndarray, "h w"]:
    """255 where corners may be taken: not on what moves, nor close to it."""
    grown = cv2.dilate(moving.astype(np.uint8), np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8))
    return np.where(grown > 0, 0, 255).astype(np.uint8)
