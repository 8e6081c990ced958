# mypy: disable-error-code="no-untyped-def"
"""Where the moving Gaussians are at one time and how they look from one point, in one pass and without gradients.

The same as `DynamicScene.at`, about seven times as fast: training renders single frames, where torch spends its time
between many small operations.
"""

import math

import numpy as np
from jaxtyping import Float32, Int32, Int64
from numpy import ndarray

from lerobot_msdyn.render.cpu.jit import device, kernel
from lerobot_msdyn.render.cpu.vectors3 import add, apply_transposed, combined, cross, dot, scaled
from lerobot_msdyn.scene.gaussians import SH_C0, SH_C1

_DEGENERATE = np.float32(1e-6)  # square of the area below which a blend has no direction (see motion.model.bases)
_C0, _C1 = np.float32(SH_C0), np.float32(SH_C1)
_ZERO, _HALF, _ONE, _TINY = np.float32(0), np.float32(0.5), np.float32(1), np.float32(1e-24)
_ZEROS = (_ZERO, _ZERO, _ZERO)
_UNTURNED = ((_ONE, _ZERO, _ZERO), (_ZERO, _ONE, _ZERO), (_ZERO, _ZERO, _ONE))


@kernel
def pose(
    means: Float32[ndarray, "n 3"],
    quats: Float32[ndarray, "n 4"],
    sh: Float32[ndarray, "n k 3"],
    affines: Float32[ndarray, "b 3 4"],
    indices: Int32[ndarray, "n j"],
    weights: Float32[ndarray, "n j"],
    bounds: Int64[ndarray, " l"],
    eye: Float32[ndarray, "3"],
    posed_means: Float32[ndarray, "n 3"],
    posed_quats: Float32[ndarray, "n 4"],
    rgb: Float32[ndarray, "n 3"],
) -> None:
    """Carry Gaussians by their levels of motion (finest first) and shade them; the last three arrays are written.

    Args:
        means: canonical positions, m.
        quats: canonical orientations wxyz.
        sh: spherical harmonics, k = 1 or 4.
        affines: maps [R | t] of all levels' bases at the time, level after level.
        indices: rows of `affines` that each Gaussian follows, the columns of one level after those of another.
        weights: shares of them, adding up to one per level.
        bounds: first column of each level, and the number of columns.
        eye: where the camera is, m.
        posed_means: positions, m.
        posed_quats: orientations wxyz.
        rgb: colours, not bounded above.
    """
    for g in range(means.shape[0]):
        point = (means[g, 0], means[g, 1], means[g, 2])
        turn = _UNTURNED
        for level in range(len(bounds) - 2, -1, -1):
            first, end = bounds[level], bounds[level + 1]
            heaviest = first
            x, y, z, shift = _ZEROS, _ZEROS, _ZEROS, _ZEROS  # columns of the blend
            for c in range(first, end):
                weight, basis = weights[g, c], indices[g, c]
                if weight > weights[g, heaviest]:
                    heaviest = c
                x = combined(_ONE, x, weight, _column(affines, basis, 0))
                y = combined(_ONE, y, weight, _column(affines, basis, 1))
                z = combined(_ONE, z, weight, _column(affines, basis, 2))
                shift = combined(_ONE, shift, weight, _column(affines, basis, 3))
            point = add(combined(point[0], x, point[1], y), combined(point[2], z, _ONE, shift))
            area = cross(x, y)
            if dot(area, area) < _DEGENERATE:
                basis = indices[g, heaviest]
                x, y = _column(affines, basis, 0), _column(affines, basis, 1)
            # the nearest rotation: Gram-Schmidt on the first two columns
            x = _normalised(x)
            y = _normalised(combined(_ONE, y, -dot(x, y), x))
            z = cross(x, y)
            turn = (_row(x, y, z, 0, turn), _row(x, y, z, 1, turn), _row(x, y, z, 2, turn))
        quat = _turned(turn, (quats[g, 0], quats[g, 1], quats[g, 2], quats[g, 3]))
        for i in range(3):
            posed_means[g, i] = point[i]
        for i in range(4):
            posed_quats[g, i] = quat[i]
        along = (point[0] - eye[0], point[1] - eye[1], point[2] - eye[2])
        length = max(dot(along, along), _TINY)
        along = scaled(_ONE / math.sqrt(length), along)
        _write_colour(sh, g, apply_transposed(turn, along), rgb)


@device
def _column(affines, basis, column):
    return (affines[basis, 0, column], affines[basis, 1, column], affines[basis, 2, column])


@device
def _normalised(vector):
    return scaled(_ONE / math.sqrt(dot(vector, vector)), vector)


@device
def _row(x, y, z, row, matrix):
    """A row of the product of the matrix of columns x, y, z and another matrix."""
    return add(combined(x[row], matrix[0], y[row], matrix[1]), scaled(z[row], matrix[2]))


@device
def _turned(turn, quat):
    """An orientation wxyz after a rotation; of the four forms of its quaternion the one of largest divisor."""
    t0 = _ONE + turn[0][0] + turn[1][1] + turn[2][2]
    t1 = _ONE + turn[0][0] - turn[1][1] - turn[2][2]
    t2 = _ONE - turn[0][0] + turn[1][1] - turn[2][2]
    t3 = _ONE - turn[0][0] - turn[1][1] + turn[2][2]
    a, b, c = turn[2][1] - turn[1][2], turn[0][2] - turn[2][0], turn[1][0] - turn[0][1]
    d, e, f = turn[0][1] + turn[1][0], turn[0][2] + turn[2][0], turn[1][2] + turn[2][1]
    if t0 >= t1 and t0 >= t2 and t0 >= t3:
        w, x, y, z = t0, a, b, c
    elif t1 >= t2 and t1 >= t3:
        w, x, y, z = a, t1, d, e
    elif t2 >= t3:
        w, x, y, z = b, d, t2, f
    else:
        w, x, y, z = c, e, f, t3
    scale = _ONE / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    return (
        w * quat[0] - x * quat[1] - y * quat[2] - z * quat[3],
        w * quat[1] + x * quat[0] + y * quat[3] - z * quat[2],
        w * quat[2] - x * quat[3] + y * quat[0] + z * quat[1],
        w * quat[3] + x * quat[2] - y * quat[1] + z * quat[0],
    )


@device
def _write_colour(sh, g, along, rgb):
    """Colour of spherical harmonics seen along a unit vector in their own axes."""
    for c in range(3):
        value = _C0 * sh[g, 0, c] + _HALF
        if sh.shape[1] > 1:
            value += _C1 * (-along[1] * sh[g, 1, c] + along[2] * sh[g, 2, c] - along[0] * sh[g, 3, c])
        rgb[g, c] = max(value, _ZERO)
