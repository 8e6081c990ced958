"""Rigid poses in float64 numpy: a scene's ground truth is exact to rounding."""

import math

import numpy as np

Triple = tuple[float | int, float | int, float | int]  # annotations are checked in tests, where an int is no float


def pose(position: Triple | np.ndarray, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """Pose [4, 4] that turns by `roll` about y, then `pitch` about x, then `yaw` about z (rad), then moves (m)."""
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_y = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    out = np.eye(4)
    out[:3, :3] = about_z @ about_x @ about_y
    out[:3, 3] = position
    return out


def from_axes(x: np.ndarray, y: np.ndarray, z: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Pose [4, 4] whose frame has the given orthonormal axes."""
    out = np.eye(4)
    out[:3, :4] = np.stack((x, y, z, position), axis=1)
    return out


def look_at(eye: np.ndarray, target: np.ndarray, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> np.ndarray:
    """World-from-camera pose [4, 4] (OpenCV axes) at `eye` with `target` in the image centre and `up` upwards."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return from_axes(right, np.cross(forward, right), forward, eye)
