"""Which way is up in a camera's picture: away from the table that it shows."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.core.geometry import unproject_image
from lerobot_msdyn.core.sampling import evenly

POINTS = 2000  # that are looked at
TRIALS = 400  # planes through three of them
NEAR_PLANE = 0.01  # share of a point's depth up to which it lies in a plane
LEAST_SHARE = 0.15  # of the points that a table holds at least
LEAST_TILT_DEG, MOST_ROLL_DEG = 3.0, 40.0  # of a camera that shows a table


def up_of(
    depth: Float[Tensor, "h w"], intrinsics: Float[Tensor, "3 3"], tilt_deg: int | float
) -> tuple[float, float, float]:
    """The vertical, a unit vector in the camera's axes (OpenCV: right, down, ahead).

    It is the normal of the plane that holds most of what the camera sees, among those a table can be: its normal points
    up in the picture, which a wall's does not, since the camera looks down. Where there is none the camera is taken to
    look `tilt_deg` below the horizontal, without roll.

    Args:
        depth: z-depth of what stands still, in any unit; 0 = unknown.
        intrinsics: K in pixels.
        tilt_deg: what is assumed where no table is seen.
    """
    points = unproject_image(depth, intrinsics)[depth > 0]
    normal = _table_normal(points[evenly(len(points), POINTS)]) if len(points) >= POINTS // 10 else None
    if normal is None:
        tilt = math.radians(tilt_deg)
        return 0.0, -math.cos(tilt), -math.sin(tilt)
    x, y, z = normal.tolist()
    return x, y, z


def _table_normal(points: Float[Tensor, "n 3"]) -> Float[Tensor, "3"] | None:
    """The normal, towards the camera, of the table plane that most points lie in; fitted to all of them."""
    generator = torch.Generator().manual_seed(0)
    three = points[torch.randint(len(points), (TRIALS, 3), generator=generator)]
    normals = torch.linalg.cross(three[:, 1] - three[:, 0], three[:, 2] - three[:, 0])
    normals = torch.nn.functional.normalize(normals, dim=1)
    heights = (normals * three[:, 0]).sum(1)
    normals, heights = (each * -heights.sign()[:, None] for each in (normals, heights[:, None]))
    near = (points @ normals.T - heights[:, 0]).abs() < NEAR_PLANE * points[:, 2:]
    count = near.sum(0) * _can_be_a_table(normals)
    best = int(count.argmax())
    if count[best] < LEAST_SHARE * len(points):
        return None
    chosen = points[near[:, best]]
    scaled = (chosen - chosen.mean(0)) / chosen[:, 2:].mean()
    normal = torch.linalg.svd(scaled, full_matrices=False).Vh[2]
    return normal * -(normal @ chosen.mean(0)).sign()


def _can_be_a_table(normals: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Whether they point up in the picture, and to the camera, which looks down."""
    x, y, z = normals.unbind(1)
    tilt, roll = torch.rad2deg(torch.asin((-z).clamp(-1, 1))), torch.rad2deg(torch.atan2(x.abs(), -y))
    return (tilt >= LEAST_TILT_DEG) & ((roll <= MOST_ROLL_DEG) | (tilt >= 90 - MOST_ROLL_DEG))
