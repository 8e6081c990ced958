"""Cameras from above, as SVG."""

from collections.abc import Sequence

import numpy as np

SIZE = 260  # px
MARGIN = 26  # px
REACH = 0.14  # length of a drawn camera, as a share of the distance to the look-at point


def cameras_from_above(cameras_from_source: Sequence[Sequence[Sequence[float]]], distance: float) -> str:
    """The recorded camera (grey), new ones (red) and the point that is looked at, in the recorded camera's axes.

    Args:
        cameras_from_source: 4x4 each, new camera from recorded camera, m.
        distance: from the recorded camera to the look-at point, m.
    """
    new = [np.linalg.inv(np.asarray(matrix, float)) for matrix in cameras_from_source]
    corners = [np.stack((*_triangle(pose, distance), _target(pose, distance))) for pose in [np.eye(4), *new]]
    points = np.concatenate(corners)
    low, high = points.min(0), points.max(0)
    scale = (SIZE - 2 * MARGIN) / max(float((high - low).max()), 1e-9)
    middle = (low + high) / 2

    def at(point: np.ndarray) -> str:
        x, y = (point - middle) * scale
        return f"{SIZE / 2 + x:.1f},{SIZE / 2 - y:.1f}"

    def camera(pose: np.ndarray, kind: str) -> str:
        sight = f"{at(pose[[0, 2], 3])} {at(_target(pose, distance))}"
        return (
            f'<polyline class="sight {kind}" points="{sight}"/>'
            f'<polygon class="{kind}" points="{" ".join(at(corner) for corner in _triangle(pose, distance))}"/>'
        )

    x, y = at(np.array([0, distance])).split(",")
    shapes = "".join(camera(pose, "new") for pose in new) + camera(np.eye(4), "recorded")
    return (
        f'<svg viewBox="0 0 {SIZE} {SIZE}" role="img" aria-label="camera poses from above">{shapes}'
        f'<circle class="target" cx="{x}" cy="{y}" r="4"/></svg>'
    )


def _target(pose: np.ndarray, distance: float) -> np.ndarray:
    """The point [2] at a distance on a camera's axis, from above."""
    return np.asarray(pose[[0, 2], 3] + pose[[0, 2], 2] * distance)


def _triangle(pose: np.ndarray, distance: float) -> np.ndarray:
    """Corners [3,2] of a camera drawn from above: its place, and the ends of its picture."""
    place, right, ahead = (pose[[0, 2], i] for i in (3, 0, 2))
    reach = REACH * distance
    return np.stack((place, place + reach * (ahead - 0.6 * right), place + reach * (ahead + 0.6 * right)))
