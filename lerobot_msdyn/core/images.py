"""What several stages do with images: the nearest pixel of some, medians over some frames, the box about a region."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, Shaped
from numpy import ndarray

MARGIN_PX = 16  # of a box about a region, so that smoothing sees enough around it


def nearest_of(marked: Bool[ndarray, "h w"]) -> Int[ndarray, "h w"]:
    """For every pixel the index, row by row, of the nearest marked pixel; 0 where none is marked.

    Distances are those of a 5x5 chamfer (Borgefors 1986), which are off by 2 % at most.
    """
    bare = (~marked).astype(np.uint8)
    _, label = cv2.distanceTransformWithLabels(bare, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    pixel = np.zeros(label.max() + 1, np.int64)
    pixel[label[marked]] = np.flatnonzero(marked)
    return pixel[label]


def masked_median(
    values: Shaped[ndarray, "t *shape"], usable: Bool[ndarray, "t *#shape"]
) -> Float32[ndarray, "*shape"]:
    """Median of every entry over the frames in which it is usable; 0 where it is in none."""
    ordered = np.sort(np.where(usable, values, np.float32(np.inf)).astype(np.float32, copy=False), axis=0)
    count = usable.sum(0)
    low, high = (
        np.take_along_axis(ordered, at.clip(0, len(values) - 1)[None], 0)[0] for at in ((count - 1) // 2, count // 2)
    )
    return np.where(count > 0, (low + high) / 2, np.float32(0))


def box_about(region: Bool[ndarray, "h w"], least: int = 1, margin: int = MARGIN_PX) -> tuple[slice, slice]:
    """Rows and columns of the smallest box about a region with a margin (px), at least `least` px to a side.

    It ends at the image's edges. About nothing it is empty.
    """
    if not region.any():
        return slice(0, 0), slice(0, 0)
    rows, columns = np.flatnonzero(region.any(1)), np.flatnonzero(region.any(0))
    return _extent(rows, region.shape[0], least, margin), _extent(columns, region.shape[1], least, margin)


def _extent(index: ndarray, size: int, least: int, margin: int) -> slice:
    first, last = int(index[0]) - margin, int(index[-1]) + 1 + margin
    first, last = max(0, first), min(size, last)
    length = min(size, max(least, last - first))
    first = min(max(0, (first + last - length) // 2), size - length)
    return slice(first, first + length)
