"""Colours of video whose chroma was recorded at half the size (4:2:0), put back where the full-size luma has edges.

Joint bilateral upsampling (Kopf et al., "Joint Bilateral Upsampling", 2007): the chroma of a pixel is the average of
the four recorded samples around it, weighted by distance and by how alike the luma is.
"""

import math
from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from lerobot_msdyn.core.compiled import compiled
from lerobot_msdyn.render.cpu.threads import in_threads

RED, GREEN, BLUE = 0.299, 0.587, 0.114  # luma of ITU-R BT.601, as decoders use it at these sizes
LUMA_SIGMA = 20.0  # difference of luma (0..255) at which a sample counts exp(-1/2)
SPACE_SIGMA_PX = 0.8
LEAST = 1e-6  # of a sample's weight by distance, which is left where none is alike

_QUARTER = np.float32(0.25)
_ALIKE = np.exp(-0.5 * (np.arange(256) / LUMA_SIGMA) ** 2).astype(np.float32) + np.float32(LEAST)
_NEAR, _FAR = (math.exp(-0.5 * (distance / SPACE_SIGMA_PX) ** 2) for distance in (0.5, 1.5))  # along one axis


def is_subsampled(pix_fmt: str) -> bool:
    """Whether the chroma of a video of this pixel format has half the size of its luma."""
    return "420" in pix_fmt


def with_chroma(frames: Iterable[UInt8[ndarray, "h w 3"]]) -> Iterator[UInt8[ndarray, "h w 3"]]:
    """Frames with chroma at full size, as they come; luma stays as it is, up to rounding and to the range of colours.

    What makes the frames goes on meanwhile.
    """
    return in_threads(_with_chroma, frames)


def _with_chroma(frame: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "h w 3"]:
    height, width, _ = frame.shape
    luma = frame.astype(np.float32) @ np.array([RED, GREEN, BLUE], np.float32)
    blocks = np.empty(((height + 1) // 2, (width + 1) // 2, 3), np.float32)
    _sample(frame, luma, blocks)
    out = np.empty_like(frame)
    _restore(luma, blocks, _ALIKE, out)
    return out


def _sampled(frame: np.ndarray, luma: np.ndarray, blocks: np.ndarray) -> None:
    """Luma, and red and blue without it, of the blocks of 2x2 pixels that share a chroma sample."""
    height, width = luma.shape
    for i in range(blocks.shape[0]):
        top, bottom = 2 * i, min(2 * i + 1, height - 1)
        for j in range(blocks.shape[1]):
            left, right = 2 * j, min(2 * j + 1, width - 1)
            a, b, c, d = luma[top, left], luma[top, right], luma[bottom, left], luma[bottom, right]
            blocks[i, j, 0] = (a + b + c + d) * _QUARTER
            for channel in range(2):
                of = 2 * channel  # red, blue
                total = (np.float32(frame[top, left, of]) - a) + (np.float32(frame[top, right, of]) - b)
                total += np.float32(frame[bottom, left, of]) - c
                total += np.float32(frame[bottom, right, of]) - d
                blocks[i, j, 1 + channel] = total * _QUARTER


def _restored(luma: np.ndarray, blocks: np.ndarray, alike: np.ndarray, out: np.ndarray) -> None:
    rows, columns = blocks.shape[:2]
    for row in range(luma.shape[0]):
        for column in range(luma.shape[1]):
            total, red, blue = 0.0, 0.0, 0.0
            for down in range(2):
                i = row // 2 + down * (2 * (row % 2) - 1)
                for right in range(2):
                    j = column // 2 + right * (2 * (column % 2) - 1)
                    if i < 0 or j < 0 or i >= rows or j >= columns:
                        continue
                    weight = (_FAR if down else _NEAR) * (_FAR if right else _NEAR)
                    weight *= alike[min(255, int(abs(blocks[i, j, 0] - luma[row, column]) + 0.5))]
                    total += weight
                    red += weight * blocks[i, j, 1]
                    blue += weight * blocks[i, j, 2]
            red, blue = red / total, blue / total
            out[row, column, 0] = min(255, max(0, round(luma[row, column] + red)))
            out[row, column, 1] = min(255, max(0, round(luma[row, column] - (RED * red + BLUE * blue) / GREEN)))
            out[row, column, 2] = min(255, max(0, round(luma[row, column] + blue)))


_sample, _restore = compiled(_sampled), compiled(_restored)
