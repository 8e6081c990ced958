"""What is done with every patch, compiled: looked up about a point of a picture, compared, moved to where it fits.

A point takes some twenty operations on 81 numbers at a time, for which NumPy would go over all patches each time.
"""

import math

import numpy as np
from numpy import ndarray

from lerobot_msdyn.core.compiled import compiled, inlined

SIDE = 9  # px
_REACH = SIDE // 2
_PARTS = 32  # of a pixel, to which positions are rounded, as OpenCV does


@inlined
def _look_up(image: ndarray, x: float, y: float, out: ndarray) -> None:
    """Bilinear values of an image in a window about a position; beyond its border those of the border."""
    height, width = image.shape
    column, row = round((x - 0.5) * _PARTS), round((y - 0.5) * _PARTS)
    left, top = column // _PARTS - _REACH, row // _PARTS - _REACH
    right, down = np.float32((column % _PARTS) / _PARTS), np.float32((row % _PARTS) / _PARTS)
    one = np.float32(1)
    a, b, c, d = (one - down) * (one - right), (one - down) * right, down * (one - right), down * right
    if left >= 0 and top >= 0 and left + SIDE < width and top + SIDE < height:
        for i in range(SIDE):
            for j in range(SIDE):
                above = image[top + i, left + j] * a + image[top + i, left + j + 1] * b
                below = image[top + i + 1, left + j] * c + image[top + i + 1, left + j + 1] * d
                out[i * SIDE + j] = above + below
        return
    for i in range(SIDE):
        upper, lower = min(max(top + i, 0), height - 1), min(max(top + i + 1, 0), height - 1)
        for j in range(SIDE):
            before, after = min(max(left + j, 0), width - 1), min(max(left + j + 1, 0), width - 1)
            above = image[upper, before] * a + image[upper, after] * b
            out[i * SIDE + j] = above + image[lower, before] * c + image[lower, after] * d


@inlined
def _less_mean(values: ndarray, weights: ndarray) -> None:
    """Take the weighted mean off some values."""
    total, mean = np.float32(0), np.float32(0)
    for k in range(SIDE * SIDE):
        total += weights[k]
        mean += weights[k] * values[k]
    mean /= total
    for k in range(SIDE * SIDE):
        values[k] -= mean


@inlined
def _products(values: ndarray, anchor: ndarray, weights: ndarray) -> tuple[float, float]:
    """Weighted means of the products of some values with a patch, and with themselves."""
    total, together, square = np.float32(0), np.float32(0), np.float32(0)
    for k in range(SIDE * SIDE):
        total += weights[k]
        together += weights[k] * values[k] * anchor[k]
        square += weights[k] * values[k] * values[k]
    return float(together / total), float(square / total)


@inlined
def _correlation(
    image: ndarray, x: float, y: float, anchor: ndarray, weights: ndarray, energy: float, noise: float, values: ndarray
) -> float:
    """Of a patch with a picture about a position; `values` are overwritten."""
    _look_up(image, x, y, values)
    _less_mean(values, weights)
    together, square = _products(values, anchor, weights)
    return (together + noise) / math.sqrt((square + noise) * (energy + noise))


def _correlations(
    image: ndarray,
    xy: ndarray,
    anchors: ndarray,
    weights: ndarray,
    energy: ndarray,
    noise: float,
    out: ndarray,
) -> None:
    values = np.empty(SIDE * SIDE, np.float32)
    for n in range(len(xy)):
        out[n] = _correlation(image, xy[n, 0], xy[n, 1], anchors[n], weights[n], energy[n], noise, values)


def _registered(
    image: ndarray,
    start: ndarray,
    anchors: ndarray,
    weights: ndarray,
    gradients: ndarray,
    energy: ndarray,
    noise: float,
    prior: float,
    iterations: int,
    most_px: float,
    least_gain: float,
    most_gain: float,
    out_xy: ndarray,
    out_ncc: ndarray,
) -> None:
    values = np.empty(SIDE * SIDE, np.float32)
    for n in range(len(start)):
        anchor, weight, gradient = anchors[n], weights[n], gradients[n]
        xx, xy, yy = np.float32(0), np.float32(0), np.float32(0)
        for k in range(SIDE * SIDE):
            xx += weight[k] * gradient[k, 0] * gradient[k, 0]
            xy += weight[k] * gradient[k, 0] * gradient[k, 1]
            yy += weight[k] * gradient[k, 1] * gradient[k, 1]
        stiff_x, stiff_y = float(xx) + prior, float(yy) + prior
        determinant = stiff_x * stiff_y - xy * xy
        x, y = start[n, 0], start[n, 1]
        for _ in range(iterations):
            _look_up(image, x, y, values)
            _less_mean(values, weight)
            square = _products(values, anchor, weight)[1]
            gain = min(max(math.sqrt((square + noise) / (energy[n] + noise)), least_gain), most_gain)
            pull_x, pull_y = np.float32(0), np.float32(0)
            for k in range(SIDE * SIDE):
                error = weight[k] * (values[k] / gain - anchor[k])
                pull_x += gradient[k, 0] * error
                pull_y += gradient[k, 1] * error
            right, down = pull_x + prior * (x - start[n, 0]), pull_y + prior * (y - start[n, 1])
            x -= (stiff_y * right - xy * down) / determinant
            y -= (stiff_x * down - xy * right) / determinant
        out_xy[n] = start[n]
        out_ncc[n] = _correlation(image, start[n, 0], start[n, 1], anchor, weight, energy[n], noise, values)
        if math.hypot(x - start[n, 0], y - start[n, 1]) < most_px:
            found = _correlation(image, x, y, anchor, weight, energy[n], noise, values)
            if found >= out_ncc[n]:
                out_xy[n, 0], out_xy[n, 1], out_ncc[n] = x, y, found


def _cut(
    image: ndarray,
    labels: ndarray,
    xy: ndarray,
    values: ndarray,
    weights: ndarray,
    gradients: ndarray,
    energy: ndarray,
) -> None:
    height, width = labels.shape
    low, high = np.empty(SIDE * SIDE, np.float32), np.empty(SIDE * SIDE, np.float32)
    for n in range(len(xy)):
        x, y = xy[n, 0], xy[n, 1]
        left, top = round(x - 0.5) - _REACH, round(y - 0.5) - _REACH
        own = labels[min(max(top + _REACH, 0), height - 1), min(max(left + _REACH, 0), width - 1)]
        for i in range(SIDE):
            for j in range(SIDE):
                row, column = min(max(top + i, 0), height - 1), min(max(left + j, 0), width - 1)
                weights[n, i * SIDE + j] = 1.0 if labels[row, column] == own else 0.0
        _look_up(image, x, y, values[n])
        _less_mean(values[n], weights[n])
        for axis in range(2):
            right, down = 0.5 * (1 - axis), 0.5 * axis
            _look_up(image, x - right, y - down, low)
            _look_up(image, x + right, y + down, high)
            for k in range(SIDE * SIDE):
                gradients[n, k, axis] = high[k] - low[k]
        energy[n] = _products(values[n], values[n], weights[n])[1]


_ANY_ORDER = {"fastmath": {"reassoc", "nsz", "contract", "arcp"}}  # of sums
correlations, registered, cut = (compiled(each, **_ANY_ORDER) for each in (_correlations, _registered, _cut))
