"""Which frames of a video stand for all of it, and lengths in pixels at any size of its pictures."""

import numpy as np
import torch
from jaxtyping import Int, UInt8
from numpy import ndarray
from torch import Tensor


def evenly(total: int, most: int) -> Int[Tensor, " n"]:
    """At most `most` of the numbers 0..total - 1, evenly spread from the first to the last, each once."""
    return torch.from_numpy(np.linspace(0, total - 1, min(total, most)).round().astype(np.int64))


REFERENCE_WIDTH = 320  # px; lengths in pixels are given for pictures of this width


def scaled_px(px: int | float, width: int) -> float:
    """A length in pixels of a picture 320 wide, in one of another width."""
    return px * width / REFERENCE_WIDTH


def scaled_window(px: int | float, width: int) -> UInt8[ndarray, "k k"]:
    """A square of ones that reaches that far to either side, at least a pixel if `px` is not 0; for `cv2.dilate`."""
    reach = max(1, round(scaled_px(px, width))) if px > 0 else 0
    return np.ones((2 * reach + 1,) * 2, np.uint8)
