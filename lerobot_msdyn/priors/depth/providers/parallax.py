"""Depth by the camera's own way: what goes by how fast."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.observations import DepthTraits
from lerobot_msdyn.priors.cache import digest_of
from lerobot_msdyn.priors.camera.sfm import SFM
from lerobot_msdyn.priors.depth.parallax import as_maps, parallax_points, spread_out
from lerobot_msdyn.priors.depth.table_plane import table_plane, with_standing
from lerobot_msdyn.priors.depth.triangulate import Points
from lerobot_msdyn.priors.registry import DEPTH, Corners, Depth, DepthProvider, Estimate, Masks, Unusable
from lerobot_msdyn.priors.request import Request

RELATIVE_ERROR = 0.05


@DEPTH.register("parallax")
class Parallax(DepthProvider):
    """What stands still, between corners that a moving camera passes; what moves stands on it.

    Rough as depth; as a reference, where only the corners count, it brings a network's depth to the unit of the poses.
    """

    rank = 15
    reads_recorded_depth = False
    is_reference = True

    def usable(self, request: Request) -> str:
        """The camera moves, with poses."""
        if request.view.camera.is_static:
            raise Unusable("the camera has no pose per frame", "give poses by --camera.poses")
        return "the camera passes what it sees"

    def estimate(self, request: Request, instances: Masks) -> Estimate[Depth]:
        """In the unit of the poses; in a plausible one where structure from motion made them."""
        points = self._points(request, instances)
        ground = torch.from_numpy(spread_out(points, request.view.camera))
        how = f"between {sum(map(len, points.values()))} corners of {len(points)} frames"
        return Estimate(self._in_unit(with_standing(ground, instances), request), how)

    def reference(self, request: Request, instances: Masks) -> Estimate[Depth]:
        """The corners alone."""
        points = self._points(request, instances)
        maps = torch.from_numpy(as_maps(points, *instances.shape))
        depth = self._in_unit(maps, request)
        unit = float(depth.z.sum() / maps.sum())
        return Estimate(replace(depth, corners=Corners(points, unit)), "corners that go by")

    def _points(self, request: Request, instances: Masks) -> dict[int, Points]:
        camera = request.view.camera

        def compute() -> dict[str, np.ndarray]:
            points = parallax_points(camera, request.view.rgb.numpy(), instances.numpy())
            numbered = [np.c_[np.full(len(cloud), frame), cloud] for frame, cloud in points.items()]
            return {"points": np.concatenate(numbered).astype(np.float32)}

        seen = camera.world_from_camera, camera.intrinsics, instances
        settings = {"seen": [digest_of(part.contiguous().view(torch.uint8)) for part in seen]}
        numbered = request.cache.get("depth", "parallax", settings, compute)["points"]
        return {int(frame): numbered[numbered[:, 0] == frame, 1:] for frame in np.unique(numbered[:, 0])}

    @staticmethod
    def _in_unit(z: Float[Tensor, "t h w"], request: Request) -> Depth:
        camera, assumed = request.view.camera, request.camera
        metric = camera.origin != SFM
        if not metric:
            table = table_plane(camera.width, camera.height, camera.intrinsics[0], assumed.height_m, assumed.tilt_deg)
            z = z * (table.median() / z[z > 0].median())
        return Depth(z, DepthTraits(metric=metric, relative_error=RELATIVE_ERROR))
