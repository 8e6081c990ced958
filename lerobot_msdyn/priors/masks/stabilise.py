"""Small motions of a camera that is meant to stand still: a swaying robot, a bumped tripod."""

import cv2
import numpy as np
from jaxtyping import Float32, Shaped, UInt8
from numpy import ndarray

from lerobot_msdyn.render.cpu.threads import in_threads

_CORNERS = 400
_MIN_CORNERS = 12  # that must agree on a frame's motion
_AGREE_PX = 0.75
_NEGLIGIBLE_PX = 0.15  # of motion, at the image's corners


def camera_sway(
    frames: UInt8[ndarray, "t h w 3"], reference: UInt8[ndarray, "h w 3"]
) -> Float32[ndarray, "t 2 3"] | None:
    """Similarities that carry the pixels of a reference image to each frame, or None if the camera stands still.

    From the corners that agree best (RANSAC), so that things which move do not matter while they cover less than about
    half of the corners. A frame with too few of them is taken to stand still.
    """
    grey = cv2.cvtColor(reference, cv2.COLOR_RGB2GRAY)
    corners = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.01, 5)
    if corners is None or len(corners) < _MIN_CORNERS:
        return None
    motions = np.stack(
        [*in_threads(lambda frame: _motion(grey, cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), corners), frames)]
    )
    height, width = grey.shape
    ends = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], np.float32)
    moved = np.linalg.norm(ends @ motions.transpose(0, 2, 1) - ends[:, :2], axis=-1)
    return motions if np.median(moved) > _NEGLIGIBLE_PX else None


def _motion(
    reference: UInt8[ndarray, "h w"], frame: UInt8[ndarray, "h w"], corners: Float32[ndarray, "n 1 2"]
) -> Float32[ndarray, "2 3"]:
    still = np.eye(2, 3, dtype=np.float32)
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(reference, frame, corners, corners.copy(), winSize=(15, 15))
    good = status[:, 0] > 0
    if good.sum() < _MIN_CORNERS:
        return still
    affine, inliers = cv2.estimateAffinePartial2D(
        corners[good], tracked[good], method=cv2.RANSAC, ransacReprojThreshold=_AGREE_PX
    )
    return still if affine is None or inliers.sum() < _MIN_CORNERS else affine.astype(np.float32)


def to_reference(images: Shaped[ndarray, "t h w *c"], sway: Float32[ndarray, "t 2 3"]) -> Shaped[ndarray, "t h w *c"]:
    """Frames as a camera that stands still would see them."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return _warped(images, sway, flags)


def to_frames(images: Shaped[ndarray, "t h w *c"], sway: Float32[ndarray, "t 2 3"]) -> Shaped[ndarray, "t h w *c"]:
    """Masks of a camera that stands still, as the swaying one sees them."""
    return _warped(images, sway, cv2.INTER_NEAREST)


def _warped(images: ndarray, sway: Float32[ndarray, "t 2 3"], flags: int) -> ndarray:
    size = (images.shape[2], images.shape[1])
    out = np.empty_like(images)
    for i, affine in enumerate(sway):
        out[i] = cv2.warpAffine(images[i], affine, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return out
