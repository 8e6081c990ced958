"""The amounts of a camera change as a matrix, and back."""

import math

import torch
from jaxtyping import Float, Float32
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.geometry import axis_angle_to_matrix, matrix_to_axis_angle, se3
from lerobot_msdyn.core.perturbation import AMOUNTS, LEVEL

SHIFT, TURN, PAN_TILT = slice(2, 5), slice(5, 8), slice(8, 10)  # of AMOUNTS


STEEPEST_DEG = 60.0  # a camera that looks down further has no horizon that could tilt: it turns about its own axes


def offsets(
    amounts: Float[Tensor, "t n"], distance: int | float, up: tuple[float, float, float] = LEVEL
) -> Float[Tensor, "t 4 4"]:
    """(Recorded camera from new camera): an orbit about the point at `distance` (m), then a shift, then turns in place.

    Args:
        amounts: as `AMOUNTS` names them.
        distance: m, to the point on the optical axis that an orbit turns about.
        up: the vertical in the recorded camera's axes.
    """
    orbit = torch.stack([orbit_offset(float(row[0]), float(row[1]), distance, up) for row in amounts])
    orbit[:, :3, 3] += amounts[:, SHIFT]
    if bool(amounts[:, PAN_TILT].any()):
        panned = torch.stack([upright_turn(float(pan), float(tilt), up) for pan, tilt in amounts[:, PAN_TILT]])
        orbit[:, :3, :3] = panned @ orbit[:, :3, :3]
    if bool(amounts[:, TURN].any()):
        orbit = orbit @ se3(axis_angle_to_matrix(torch.deg2rad(amounts[:, TURN])), torch.zeros(len(amounts), 3))
    return orbit


def orbit_offset(
    azimuth_deg: int | float,
    elevation_deg: int | float,
    distance: int | float,
    up: tuple[float, float, float] = LEVEL,
) -> Float[Tensor, "4 4"]:
    """A camera moved on a sphere about the point at `distance` on its optical axis, still looking at it.

    Positive azimuth moves the camera to its right, about the vertical; positive elevation up, about the horizontal:
    what was upright in the picture is upright in the new one. The result maps the new camera's coordinates to the
    recorded camera's.
    """
    turn = upright_turn(-azimuth_deg, -elevation_deg, up)
    point = torch.tensor([0.0, 0.0, float(distance)])
    return se3(turn, point - turn @ point)


def upright_turn(pan_deg: int | float, tilt_deg: int | float, up: tuple[float, float, float]) -> Float[Tensor, "3 3"]:
    """A turn to the right about the vertical, and one up about the horizontal: (recorded from new camera's axes)."""
    down, ahead = -torch.tensor(up), torch.tensor([0.0, 0.0, 1.0])
    if math.degrees(math.asin(min(1.0, abs(float(down[2]))))) > STEEPEST_DEG:
        down = -torch.tensor(LEVEL)
    right = torch.nn.functional.normalize(torch.linalg.cross(down, ahead), dim=0)
    turns = torch.stack([math.radians(pan_deg) * down, math.radians(tilt_deg) * right])
    about_down, about_right = axis_angle_to_matrix(turns)
    return about_down @ about_right


def amounts_of_pose(offset: Float[Tensor, "4 4"]) -> Float32[ndarray, "1 n"]:
    """The amounts of a change given as (recorded camera from new camera): a shift and a turn about one axis."""
    amounts = torch.zeros(1, len(AMOUNTS))
    amounts[0, SHIFT] = offset[:3, 3]
    amounts[0, TURN] = torch.rad2deg(matrix_to_axis_angle(offset[:3, :3]))
    return amounts.numpy()
