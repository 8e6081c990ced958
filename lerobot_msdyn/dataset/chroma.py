"""Colours of video whose chroma was recorded at half the size (4:2:0), put back where the full-size luma has edges.

Joint bilateral upsampling (Kopf et al., "Joint Bilateral Upsampling", 2007): the chroma of a pixel is the average of
the four recorded samples around it, weighted by distance and by how alike the luma is.
"""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float32, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.compiled import compiled
from lerobot_msdyn.render.cpu.threads import in_threads

RED, GREEN, BLUE = 0.299, 0.587, 0.114  # luma of ITU-R BT.601, as decoders use it at these sizes
LUMA_SIGMA = 20.0  # difference of luma (0..255) at which a sample counts exp(-1/2)
SPACE_SIGMA_PX = 0.8
LEAST = 1e-6  # of a sample's weight by distance, which is left where none is alike

_ALIKE = np.exp(-0.5 * (np.arange(256) / LUMA_SIGMA) ** 2).astype(np.float32) + np.float32(LEAST)
_NEAR, _FAR = (math.exp(-0.5 * (distance / SPACE_SIGMA_PX) ** 2) for distance in (0.5, 1.5))  # along one axis


def is_subsampled(pix_fmt: str) -> bool:
    """Whether the chroma of a video of this pixel format has half the size of its luma."""
    return "420" in pix_fmt


def restore_chroma(frames: UInt8[Tensor, "t h w 3"]) -> UInt8[Tensor, "t h w 3"]:
    """The same frames with chroma at full size; luma stays as it is, up to rounding and to the range of colours."""

    def restored(frame: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "h w 3"]:
        out = np.empty_like(frame)
        luma = frame.astype(np.float32) @ np.array([RED, GREEN, BLUE], np.float32)
        _restore(luma, *_samples(frame, luma), _ALIKE, out)
        return out

    whole = np.empty(frames.shape, np.uint8)
    for place, frame in zip(whole, in_threads(restored, frames.contiguous().numpy()), strict=True):
        place[:] = frame
    return torch.from_numpy(whole)


def _samples(
    frame: UInt8[ndarray, "h w 3"], luma: Float32[ndarray, "h w"]
) -> tuple[Float32[ndarray, "h2 w2"], Float32[ndarray, "h2 w2 2"]]:
    """Luma, and red and blue without it, of the blocks of 2x2 pixels that share a chroma sample."""
    height, width = luma.shape
    values = np.dstack((luma, frame[..., 0] - luma, frame[..., 2] - luma))
    padded = np.pad(values, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    size = padded.shape[1] // 2, padded.shape[0] // 2
    blocks = cv2.resize(padded, size, interpolation=cv2.INTER_AREA)  # at half the size: means of blocks
    return np.ascontiguousarray(blocks[..., 0]), np.ascontiguousarray(blocks[..., 1:])


def _restored(
    luma: np.ndarray, block_luma: np.ndarray, block_chroma: np.ndarray, alike: np.ndarray, out: np.ndarray
) -> None:
    rows, columns = block_luma.shape
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
                    weight *= alike[min(255, int(abs(block_luma[i, j] - luma[row, column]) + 0.5))]
                    total += weight
                    red += weight * block_chroma[i, j, 0]
                    blue += weight * block_chroma[i, j, 1]
            red, blue = red / total, blue / total
            out[row, column, 0] = min(255, max(0, round(luma[row, column] + red)))
            out[row, column, 1] = min(255, max(0, round(luma[row, column] - (RED * red + BLUE * blue) / GREEN)))
            out[row, column, 2] = min(255, max(0, round(luma[row, column] + blue)))


_restore = compiled(_restored)
