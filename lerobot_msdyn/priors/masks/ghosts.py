"""Places that only seem to be covered because the picture of the empty scene shows something there.

Where an object rests for most of a clip, it is in the temporal median, and the ground that it leaves bare looks like a
thing that has come. Such a ghost is told from a thing that has come to rest by its outline: what belongs to the
ground goes on beyond it, what lies on the ground ends there.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Int, UInt8
from numpy import ndarray

from lerobot_msdyn.core.images import masked_median, nearest_of
from lerobot_msdyn.priors.masks.change import to_lab

_REST_FRAMES = 8  # of the clip, for which a place has to look the same
_STILL = 6  # grey levels up to which two pictures of a place look the same
_OTHER = 8.0  # Lab units, of the difference to the picture of the empty scene
_TOGETHER = 0.5  # share of frames that neighbouring pixels rest together, to belong to one place
_MIN_AREA = 5e-4  # of the image
_MIN_OUTLINE = 30  # px
_BARE = 0.2  # share of the frames for which the outline may be covered
_STRONGEST = 30.0  # Lab units; stronger edges count no more
_CLEARLY = 1.5  # Lab units, by which the outline of the one picture must be stronger than that of the other


def without_ghosts(
    frames: UInt8[ndarray, "s h w 3"],
    moving: Bool[ndarray, "s h w"],
    empty: UInt8[ndarray, "h w 3"],
    stride: float,
) -> tuple[UInt8[ndarray, "h w 3"], Bool[ndarray, "h w"]]:
    """The picture of the empty scene without things that only rested there, and where it was changed.

    `frames` are taken every `stride` frames from the clip; `moving` is what seems to be covered in them.
    """
    resting = _resting(frames, moving, stride)
    often = resting.sum(0) >= max(2, round(_REST_FRAMES / stride))
    seen = median_where(frames, resting, often, empty)
    lab_seen, lab_empty = to_lab(seen), to_lab(empty)
    places = _places(resting, often & (np.linalg.norm(lab_seen - lab_empty, axis=-1) > _OTHER))
    mended, changed = empty.copy(), np.zeros(often.shape, bool)
    for place in np.flatnonzero(np.bincount(places.ravel()) >= _MIN_AREA * often.size):
        inside = places == place
        if place == 0 or not _goes_on(inside, often, resting, moving, lab_seen, lab_empty):
            continue
        mended[inside], changed[inside] = seen[inside], True
    return mended, changed


def median_where(
    frames: UInt8[ndarray, "t h w 3"],
    usable: Bool[ndarray, "t h w"],
    where: Bool[ndarray, "h w"],
    otherwise: UInt8[ndarray, "h w 3"],
) -> UInt8[ndarray, "h w 3"]:
    """Median colour of every pixel of a region over the frames in which it is usable; elsewhere `otherwise`."""
    out = otherwise.copy()
    where = where & usable.any(0)
    out[where] = masked_median(frames[:, where], usable[:, where, None]).round().astype(np.uint8)
    return out


def _resting(
    frames: UInt8[ndarray, "s h w 3"], moving: Bool[ndarray, "s h w"], stride: float
) -> Bool[ndarray, "s h w"]:
    """Covered pixels that look as they did half a rest before."""
    grey = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames])
    step = max(1, round(_REST_FRAMES / 2 / stride))
    resting = np.zeros(moving.shape, bool)
    for t in range(step, len(frames)):
        resting[t] = moving[t] & moving[t - step] & (cv2.absdiff(grey[t], grey[t - step]) < _STILL)
    return resting


def _places(resting: Bool[ndarray, "s h w"], where: Bool[ndarray, "h w"]) -> Int[ndarray, "h w"]:
    """Connected pixels that rest in the same frames, numbered from 1."""
    height, width = where.shape
    grid = np.zeros((2 * height - 1, 2 * width - 1), np.uint8)  # pixels, and between them the links
    grid[::2, ::2] = where

    def linked(a: ndarray, b: ndarray) -> ndarray:
        return (a & b).sum(0) > _TOGETHER * np.maximum((a | b).sum(0), 1)

    grid[::2, 1::2] = linked(resting[:, :, 1:], resting[:, :, :-1]) & where[:, 1:] & where[:, :-1]
    grid[1::2, ::2] = linked(resting[:, 1:], resting[:, :-1]) & where[1:] & where[:-1]
    return cv2.connectedComponents(grid, connectivity=4)[1][::2, ::2]


def _goes_on(
    inside: Bool[ndarray, "h w"],
    often: Bool[ndarray, "h w"],
    resting: Bool[ndarray, "s h w"],
    moving: Bool[ndarray, "s h w"],
    seen: ndarray,
    empty: ndarray,
) -> bool:
    """Whether the picture that is seen in a place continues around it, where the empty scene's picture does not."""
    mask = inside.astype(np.uint8)
    wide, narrow = np.ones((7, 7), np.uint8), np.ones((3, 3), np.uint8)
    around = (cv2.dilate(mask, wide) > cv2.dilate(mask, narrow)) & ~often
    meanwhile = resting[:, inside].mean(1) > 0.3
    if not meanwhile.any():
        return False
    around &= moving[meanwhile].mean(0) < _BARE
    if around.sum() < _MIN_OUTLINE:
        return False
    rim = inside & (cv2.erode(mask, wide) == 0)
    across = nearest_of(rim)[around]

    def edge(image: ndarray) -> ndarray:
        step = np.linalg.norm(empty[around] - image.reshape(-1, 3)[across], axis=-1)
        return np.minimum(step, _STRONGEST)

    return bool((edge(empty) - edge(seen)).mean() > _CLEARLY)
