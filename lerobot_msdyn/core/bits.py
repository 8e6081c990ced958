"""Rows of booleans as bits, eight to a byte, most significant first."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor


def packed_rows(rows: Sequence[Bool[Tensor, " _"]]) -> UInt8[Tensor, "t bytes"]:
    """Rows that may be of different lengths; shorter ones are continued by False."""
    packed = [np.packbits(row.numpy()) for row in rows]
    together = np.zeros((len(packed), max((len(row) for row in packed), default=0)), np.uint8)
    for row, bits in zip(together, packed, strict=True):
        row[: len(bits)] = bits
    return torch.from_numpy(together)


def unpacked(row: UInt8[Tensor, " bytes"], count: int) -> Bool[Tensor, " count"]:
    """The first of a row's booleans, where it is."""
    places = torch.arange(7, -1, -1, dtype=torch.uint8, device=row.device)
    return ((row[:, None] >> places) & 1).bool().flatten()[:count]
