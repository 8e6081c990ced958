# mypy: disable-error-code="no-untyped-def"
"""Small vectors and matrices for the scalar kernels: 3-tuples of float32, and 3-tuples of such rows."""

import numpy as np

from lerobot_msdyn.render.cpu.jit import device

_ONE = np.float32(1)


@device
def dot(a, b):
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@device
def add(a, b):
    """Sum."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@device
def scaled(factor, a):
    """Multiple of a vector."""
    return (factor * a[0], factor * a[1], factor * a[2])


@device
def combined(p, a, q, b):
    """Weighted sum p a + q b."""
    return (p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2])


@device
def times(a, b):
    """Elementwise product."""
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


@device
def cross(a, b):
    """Vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@device
def apply(matrix, a):
    """Product matrix @ a."""
    return (dot(matrix[0], a), dot(matrix[1], a), dot(matrix[2], a))


@device
def apply_transposed(matrix, a):
    """Product matrix.T @ a."""
    rows = combined(a[0], matrix[0], a[1], matrix[1])
    return add(rows, scaled(a[2], matrix[2]))


@device
def scale_columns(matrix, factors):
    """Product matrix @ diag(factors)."""
    return (times(matrix[0], factors), times(matrix[1], factors), times(matrix[2], factors))


@device
def rotation_of(quat):
    """Rotation matrix of a unit quaternion wxyz."""
    w, x, y, z = quat
    x2, y2, z2 = x + x, y + y, z + z
    return (
        (_ONE - (y * y2 + z * z2), x * y2 - w * z2, x * z2 + w * y2),
        (x * y2 + w * z2, _ONE - (x * x2 + z * z2), y * z2 - w * x2),
        (x * z2 - w * y2, y * z2 + w * x2, _ONE - (x * x2 + y * y2)),
    )


@device
def rotation_gradient(quat, inverse, g):
    """Gradient of the unnormalised quaternion, from the gradient g of its rotation matrix.

    `quat` is the unit quaternion wxyz, `inverse` one over the length that it had.
    """
    w, x, y, z = quat
    two = np.float32(2)
    of_w = x * (g[2][1] - g[1][2]) + y * (g[0][2] - g[2][0]) + z * (g[1][0] - g[0][1])
    of_x = y * (g[0][1] + g[1][0]) + z * (g[0][2] + g[2][0]) + w * (g[2][1] - g[1][2])
    of_x -= two * x * (g[1][1] + g[2][2])
    of_y = x * (g[0][1] + g[1][0]) + z * (g[1][2] + g[2][1]) + w * (g[0][2] - g[2][0])
    of_y -= two * y * (g[0][0] + g[2][2])
    of_z = x * (g[0][2] + g[2][0]) + y * (g[1][2] + g[2][1]) + w * (g[1][0] - g[0][1])
    of_z -= two * z * (g[0][0] + g[1][1])
    radial = of_w * w + of_x * x + of_y * y + of_z * z
    factor = two * inverse
    return (
        factor * (of_w - radial * w),
        factor * (of_x - radial * x),
        factor * (of_y - radial * y),
        factor * (of_z - radial * z),
    )
