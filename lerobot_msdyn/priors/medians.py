"""Medians over the frames in which a pixel can be used."""

import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray

_UNUSABLE = np.iinfo(np.uint16).max  # sorts behind every grey level


def median_where(
    frames: UInt8[ndarray, "t h w 3"],
    usable: Bool[ndarray, "t h w"],
    where: Bool[ndarray, "h w"],
    otherwise: UInt8[ndarray, "h w 3"],
) -> UInt8[ndarray, "h w 3"]:
    """Median colour of every pixel of a region over the frames in which it is usable; elsewhere `otherwise`."""
    out = otherwise.copy()
    where = where & usable.any(0)
    chosen = usable[:, where]
    values = np.where(chosen[..., None], frames[:, where], np.uint16(_UNUSABLE))
    values.sort(axis=0)
    middle = chosen.sum(0) - 1
    pixels = np.arange(len(middle))
    low, high = values[middle // 2, pixels], values[(middle + 1) // 2, pixels]
    out[where] = ((low + high) / 2).round().astype(np.uint8)
    return out
