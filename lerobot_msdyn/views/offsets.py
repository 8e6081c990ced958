"""The amounts of a camera change as a matrix, and back."""

import math

import torch
from jaxtyping import Float, Float32
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.geometry import axis_angle_to_matrix, matrix_to_axis_angle, se3
from lerobot_msdyn.core.perturbation import AMOUNTS

SHIFT, TURN = slice(2, 5), slice(5, 8)  # of AMOUNTS


def offsets(amounts: Float[Tensor, "t n"], distance: int | float) -> Float[Tensor, "t 4 4"]:
    """(Recorded camera from new camera): an orbit about the point at `distance` (m), then a shift, then a turn."""
    orbit = torch.stack([orbit_offset(float(row[0]), float(row[1]), distance) for row in amounts])
    orbit[:, :3, 3] += amounts[:, SHIFT]
    if not bool(amounts[:, TURN].any()):
        return orbit
    return orbit @ se3(axis_angle_to_matrix(torch.deg2rad(amounts[:, TURN])), torch.zeros(len(amounts), 3))


def orbit_offset(azimuth_deg: int | float, elevation_deg: int | float, distance: int | float) -> Float[Tensor, "4 4"]:
    """A camera moved on a sphere about the point at `distance` on its optical axis, still looking at it.

    Positive azimuth moves the camera to its right, positive elevation up; the result maps the new camera's
    coordinates to the recorded camera's.
    """
    # The camera's y axis points down: turning the camera to its right about the point is a negative turn about it.
    a, e = -math.radians(azimuth_deg), -math.radians(elevation_deg)
    sin_a, cos_a, sin_e, cos_e = math.sin(a), math.cos(a), math.sin(e), math.cos(e)
    ahead = (sin_a * cos_e, -sin_e, cos_a * cos_e)  # the new optical axis
    return torch.tensor(
        [
            [cos_a, sin_a * sin_e, ahead[0], -distance * ahead[0]],
            [0.0, cos_e, ahead[1], -distance * ahead[1]],
            [-sin_a, cos_a * sin_e, ahead[2], distance - distance * ahead[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def amounts_of_pose(offset: Float[Tensor, "4 4"]) -> Float32[ndarray, "1 n"]:
    """The amounts of a change given as (recorded camera from new camera): a shift and a turn about one axis."""
    amounts = torch.zeros(1, len(AMOUNTS))
    amounts[0, SHIFT] = offset[:3, 3]
    amounts[0, TURN] = torch.rad2deg(matrix_to_axis_angle(offset[:3, :3]))
    return amounts.numpy()
