"""Where points land in a picture, and whether it shows them: the one way to ask."""

from dataclasses import dataclass
from functools import cached_property

from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import nearest_pixel, project, transform_points

TOLERANCE = 0.01  # share of a surface's depth by which a point may lie behind it and still be what is seen


@dataclass(frozen=True)
class Projection:
    """Points as a camera sees them."""

    xy: Float[Tensor, "n 2"]  # px
    z: Float[Tensor, " n"]  # z-depth, m
    width: int
    height: int

    @cached_property
    def inside(self) -> Bool[Tensor, " n"]:
        """Which are in front of the camera and inside of its picture."""
        x, y = self.xy.unbind(-1)
        return (self.z > 0) & (x >= 0) & (y >= 0) & (x < self.width) & (y < self.height)

    @cached_property
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
