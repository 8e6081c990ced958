"""Where the moving Gaussians are at one time and how they look from one point, in one pass and without gradients.

The same as `DynamicScene.at`, about seven times as fast: training draws single frames, where torch spends its time
between many small operations.
"""

import math

import numpy as np
from jaxtyping import Float32, Int32, Int64
from numpy import ndarray

from lerobot_msdyn.render.jit import kernel
from lerobot_msdyn.scene import SH_C0, SH_C1

_DEGENERATE = np.float32(1e-6)  # square of the area below which a blend has no direction left (as in motion.bases)
_C0, _C1 = np.float32(SH_C0), np.float32(SH_C1)
_HALF, _ONE = np.float32(0.5), np.float32(1)


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
    a = np.empty((3, 4), np.float32)
    r = np.empty((3, 3), np.float32)
    turn = np.empty((3, 3), np.float32)
    new = np.empty((3, 3), np.float32)
    for g in range(means.shape[0]):
        x, y, z = means[g, 0], means[g, 1], means[g, 2]
        for i in range(3):
            for j in range(3):
                turn[i, j] = _ONE if i == j else np.float32(0)
        for level in range(len(bounds) - 2, -1, -1):
            first, end = bounds[level], bounds[level + 1]
            heaviest = first
            a[:] = np.float32(0)
            for c in range(first, end):
                w = weights[g, c]
                if w > weights[g, heaviest]:
                    heaviest = c
                basis = indices[g, c]
                for i in range(3):
                    for j in range(4):
                        a[i, j] += w * affines[basis, i, j]
            x, y, z = (
                a[0, 0] * x + a[0, 1] * y + a[0, 2] * z + a[0, 3],
                a[1, 0] * x + a[1, 1] * y + a[1, 2] * z + a[1, 3],
                a[2, 0] * x + a[2, 1] * y + a[2, 2] * z + a[2, 3],
            )
            # the nearest rotation: Gram-Schmidt on the first two columns
            cx = a[1, 0] * a[2, 1] - a[2, 0] * a[1, 1]
            cy = a[2, 0] * a[0, 1] - a[0, 0] * a[2, 1]
            cz = a[0, 0] * a[1, 1] - a[1, 0] * a[0, 1]
            if cx * cx + cy * cy + cz * cz < _DEGENERATE:
                for i in range(3):
                    a[i, 0] = affines[indices[g, heaviest], i, 0]
                    a[i, 1] = affines[indices[g, heaviest], i, 1]
            scale = _ONE / np.float32(math.sqrt(a[0, 0] ** 2 + a[1, 0] ** 2 + a[2, 0] ** 2))
            for i in range(3):
                r[i, 0] = a[i, 0] * scale
            along = r[0, 0] * a[0, 1] + r[1, 0] * a[1, 1] + r[2, 0] * a[2, 1]
            for i in range(3):
                r[i, 1] = a[i, 1] - along * r[i, 0]
            scale = _ONE / np.float32(math.sqrt(r[0, 1] ** 2 + r[1, 1] ** 2 + r[2, 1] ** 2))
            for i in range(3):
                r[i, 1] *= scale
            r[0, 2] = r[1, 0] * r[2, 1] - r[2, 0] * r[1, 1]
            r[1, 2] = r[2, 0] * r[0, 1] - r[0, 0] * r[2, 1]
            r[2, 2] = r[0, 0] * r[1, 1] - r[1, 0] * r[0, 1]
            for i in range(3):
                for j in range(3):
                    new[i, j] = r[i, 0] * turn[0, j] + r[i, 1] * turn[1, j] + r[i, 2] * turn[2, j]
            turn, new = new, turn
        posed_means[g, 0], posed_means[g, 1], posed_means[g, 2] = x, y, z
        _turned(turn, quats[g], posed_quats[g])
        _shaded(turn, sh[g], x - eye[0], y - eye[1], z - eye[2], rgb[g])


@kernel
def _turned(turn: ndarray, quat: ndarray, out: ndarray) -> None:
    """An orientation wxyz after a rotation; of the four forms of its quaternion the one of largest divisor."""
    t0 = _ONE + turn[0, 0] + turn[1, 1] + turn[2, 2]
    t1 = _ONE + turn[0, 0] - turn[1, 1] - turn[2, 2]
    t2 = _ONE - turn[0, 0] + turn[1, 1] - turn[2, 2]
    t3 = _ONE - turn[0, 0] - turn[1, 1] + turn[2, 2]
    a, b, c = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
    d, e, f = turn[0, 1] + turn[1, 0], turn[0, 2] + turn[2, 0], turn[1, 2] + turn[2, 1]
    if t0 >= t1 and t0 >= t2 and t0 >= t3:
        w, x, y, z = t0, a, b, c
    elif t1 >= t2 and t1 >= t3:
        w, x, y, z = a, t1, d, e
    elif t2 >= t3:
        w, x, y, z = b, d, t2, f
    else:
        w, x, y, z = c, e, f, t3
    scale = _ONE / np.float32(math.sqrt(w * w + x * x + y * y + z * z))
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    out[0] = w * quat[0] - x * quat[1] - y * quat[2] - z * quat[3]
    out[1] = w * quat[1] + x * quat[0] + y * quat[3] - z * quat[2]
    out[2] = w * quat[2] - x * quat[3] + y * quat[0] + z * quat[1]
    out[3] = w * quat[3] + x * quat[2] - y * quat[1] + z * quat[0]


@kernel
def _shaded(turn: ndarray, sh: ndarray, dx: np.float32, dy: np.float32, dz: np.float32, out: ndarray) -> None:
    """Colour of spherical harmonics that turned with their Gaussian, seen along a direction of any length."""
    scale = _ONE / max(np.float32(math.sqrt(dx * dx + dy * dy + dz * dz)), np.float32(1e-12))
    x = (turn[0, 0] * dx + turn[1, 0] * dy + turn[2, 0] * dz) * scale
    y = (turn[0, 1] * dx + turn[1, 1] * dy + turn[2, 1] * dz) * scale
    z = (turn[0, 2] * dx + turn[1, 2] * dy + turn[2, 2] * dz) * scale
    for c in range(3):
        value = _C0 * sh[0, c] + _HALF
        if sh.shape[0] > 1:
            value += _C1 * (-y * sh[1, c] + z * sh[2, c] - x * sh[3, c])
        out[c] = max(value, np.float32(0))
