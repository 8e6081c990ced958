"""Which frames of a video stand for all of it."""

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor


def evenly(total: int, most: int) -> Int[Tensor, " n"]:
    """At most `most` of the numbers 0..total - 1, evenly spread from the first to the last, each once."""
    return torch.from_numpy(np.linspace(0, total - 1, min(total, most)).round().astype(np.int64))
