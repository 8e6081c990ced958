"""The pictures of the report, as data URLs: strips, clips and maps of what is uncovered."""

import base64
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Int, UInt8
from numpy import ndarray

from lerobot_msdyn.core.sampling import evenly

CLIP_FRAMES = 12
STRIP_FRAMES = 5
CLIP_WIDTH = 240  # px, of one picture
STRIP_WIDTH = 224  # px
FULL_WIDTH = 960  # px, at most
JPEG_QUALITY = 72
GAP_PX = 4
PAPER = 255


def data_url(picture: UInt8[ndarray, "h w 3"]) -> str:
    """A picture as a JPEG inside a URL."""
    settings = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    content = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), settings)[1]
    return jpeg_url(content.tobytes())


def jpeg_url(content: bytes) -> str:
    """The bytes of a JPEG inside a URL."""
    return "data:image/jpeg;base64," + base64.b64encode(content).decode("ascii")


def spread(total: int, count: int) -> Int[ndarray, " n"]:
    """At most `count` of `total` frames, evenly spread."""
    return evenly(total, count).numpy()


def strip(before: Sequence[ndarray], after: Sequence[ndarray]) -> UInt8[ndarray, "h w 3"]:
    """Some moments beside each other: recorded above, new below."""
    rows = [_beside([_narrowed(picture, STRIP_WIDTH) for picture in row]) for row in (before, after)]
    gap = np.full((GAP_PX, rows[0].shape[1], 3), PAPER, np.uint8)
    return np.concatenate((rows[0], gap, rows[1]))


def film(before: Sequence[ndarray], after: Sequence[ndarray]) -> UInt8[ndarray, "h w 3"]:
    """The moments of a clip beside each other, each the recorded picture left of the new one; the page moves it."""
    pairs = [
        np.concatenate((_narrowed(one, CLIP_WIDTH), _narrowed(other, CLIP_WIDTH)), axis=1)
        for one, other in zip(before, after, strict=True)
    ]
    return np.concatenate(pairs, axis=1)


def full_size(picture: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "height width 3"]:
    """A picture as it is, but for very wide ones."""
    return _narrowed(picture, min(picture.shape[1], FULL_WIDTH))


def side_by_side(before: UInt8[ndarray, "h w 3"], after: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "height width 3"]:
    """A recorded picture and a new one of its size."""
    return _beside([_narrowed(picture, min(picture.shape[1], CLIP_WIDTH * 2)) for picture in (before, after)])


def heat_map(picture: UInt8[ndarray, "h w 3"], percent: Sequence[Sequence[int]]) -> UInt8[ndarray, "height width 3"]:
    """A new picture in grey, red where the frames show what no recorded frame has shown."""
    small = _narrowed(picture, STRIP_WIDTH)
    height, width = small.shape[:2]
    uncovered = cv2.resize(np.asarray(percent, np.float32) / 100, (width, height), interpolation=cv2.INTER_LINEAR)
    grey = np.repeat(small.mean(-1, keepdims=True), 3, axis=-1) * 0.7 + 60
    weight = 0.85 * uncovered.clip(0, 1)[..., None]
    return (grey * (1 - weight) + np.array([214, 40, 40]) * weight).clip(0, 255).astype(np.uint8)


def _beside(pictures: Sequence[ndarray]) -> UInt8[ndarray, "h w 3"]:
    gap = np.full((pictures[0].shape[0], GAP_PX, 3), PAPER, np.uint8)
    parts = [part for picture in pictures for part in (picture, gap)][:-1]
    return np.concatenate(parts, axis=1)


def _narrowed(picture: UInt8[ndarray, "h w 3"], width: int) -> UInt8[ndarray, "height width 3"]:
    height = max(1, round(width * picture.shape[0] / picture.shape[1]))
    way = cv2.INTER_AREA if width < picture.shape[1] else cv2.INTER_LINEAR
    return cv2.resize(picture, (width, height), interpolation=way)
