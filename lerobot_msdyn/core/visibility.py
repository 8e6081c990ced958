"""Where points land in a picture, and whether it shows them: the one way to ask."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import nearest_pixel, project, transform_points

SIGMAS = 3.33  # standard deviations to where a Gaussian is no longer shown (alpha of 1/255)
MOST_STRETCH = 3.0  # by which one beside the optical axis, where perspective is still linear, is longer than on it
BLUR_PX2 = 0.3  # variance of a rasterizer's low-pass filter
SLACK_PX = 1.0  # by which distances between pixels may be off
TOLERANCE = 0.01  # share of a surface's depth by which a point may lie behind it and still be what is seen


@dataclass(frozen=True)
class Projection:
    """Points as a camera sees them."""

    xy: Float[Tensor, "n 2"]  # px
    z: Float[Tensor, " n"]  # z-depth, m
    width: int
    height: int

    @property
    def inside(self) -> Bool[Tensor, " n"]:
        """Which are in front of the camera and inside of its picture."""
        x, y = self.xy.unbind(-1)
        return (self.z > 0) & (x >= 0) & (y >= 0) & (x < self.width) & (y < self.height)

    @property
    def pixel(self) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
        """Row and column of the pixel of each; of the nearest one of the border where a point is outside."""
        return nearest_pixel(self.xy, self.width, self.height)

    def visible(self, depth: Float[Tensor, "h w"], tolerance: float = TOLERANCE) -> Bool[Tensor, " n"]:
        """Which are inside and not behind what the picture shows at their pixel, whose depth is `depth` (m)."""
        return self.inside & (self.z < (1 + tolerance) * depth[self.pixel])


def projected(points: Float[Tensor, "n 3"], camera: CameraTrack) -> Projection:
    """Points (m, world) through the first pose of a camera."""
    xy, z = project(transform_points(camera.camera_from_world[0], points), camera.intrinsics[0])
    return Projection(xy, z, camera.width, camera.height)


@dataclass(frozen=True)
class Footprints:
    """About where a camera sees Gaussians."""

    pixel: Int[Tensor, " n"]  # of the centre, row by row; of the nearest one where the centre is outside
    reach: Float[Tensor, " n"]  # px, from there, within which all that it may cover lies; below 0: it is not seen

    def may_cover(self, where: Bool[ndarray, "h w"]) -> Bool[Tensor, " n"]:
        """Which may cover any of some pixels: all that do, and some that do not."""
        distance = cv2.distanceTransform((~where).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)
        return torch.from_numpy(distance).to(self.pixel.device).flatten()[self.pixel] <= self.reach


def footprints(means: Float[Tensor, "n 3"], sizes: Float[Tensor, " n"], camera: CameraTrack) -> Footprints:
    """Those of Gaussians at some places (m, world) through the first pose of a camera.

    `sizes` (m) are their largest standard deviations.
    """
    seen = projected(means, camera)
    row, column = seen.pixel
    focal, centre = camera.intrinsics[0, 0, 0], camera.intrinsics[0, :2, 2]
    stretch = (1 + ((seen.xy - centre) / focal).square().sum(-1)).sqrt().clamp(max=MOST_STRETCH)
    deviation_px = stretch * sizes * focal / seen.z.clamp(min=1e-6)
    reach = SLACK_PX + SIGMAS * (deviation_px.square() + BLUR_PX2).sqrt()
    return Footprints(row * camera.width + column, reach.masked_fill(seen.z <= 0, -1.0))
