"""The part of a picture that has to be looked at."""

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

MARGIN_PX = 16  # of a box about what it holds, so that smoothing sees enough around it


def box_about(region: Bool[ndarray, "h w"], least: int = 1) -> tuple[slice, slice]:
    """Rows and columns of the smallest box about a region with a margin of 16 px, at least `least` px to a side.

    It ends at the picture's edges. About nothing it is empty.
    """
    if not region.any():
        return slice(0, 0), slice(0, 0)
    rows, columns = np.flatnonzero(region.any(1)), np.flatnonzero(region.any(0))
    return _extent(rows, region.shape[0], least), _extent(columns, region.shape[1], least)


def _extent(index: ndarray, size: int, least: int) -> slice:
    first, last = int(index[0]) - MARGIN_PX, int(index[-1]) + 1 + MARGIN_PX
    first, last = max(0, first), min(size, last)
    length = min(size, max(least, last - first))
    first = min(max(0, (first + last - length) // 2), size - length)
    return slice(first, first + length)
