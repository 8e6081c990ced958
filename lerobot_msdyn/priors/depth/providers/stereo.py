"""Depth from two or more calibrated cameras that see the same moments."""

import numpy as np
import torch

from lerobot_msdyn.core.observations import DepthTraits
from lerobot_msdyn.priors.cache import digest_of
from lerobot_msdyn.priors.depth.multiview import multiview_depth, usable_partners, why_no_partner
from lerobot_msdyn.priors.registry import DEPTH, Depth, DepthProvider, Estimate, Masks, Unusable
from lerobot_msdyn.priors.request import Request


@DEPTH.register("stereo")
class Stereo(DepthProvider):
    """Rectified pairs where cameras stand side by side, else triangulated features."""

    rank = 20
    is_reference = True

    def usable(self, request: Request) -> str:
        """Another calibrated camera sees about the same things."""
        if not usable_partners(request.view, request.others):
            raise Unusable(
                why_no_partner(request.view, request.others),
                "name two or more cameras of the episode in --camera.calibration and in --cameras",
            )
        return "other calibrated cameras see the scene"

    def estimate(self, request: Request, instances: Masks) -> Estimate[Depth]:
        """In the metres of the calibration."""
        partners = usable_partners(request.view, request.others)
        cameras = [view.camera for view in (request.view, *partners)]

        def compute() -> dict[str, np.ndarray]:
            return {"depth": multiview_depth(request.view, partners, instances).numpy().astype(np.float16)}

        settings = {
            "cameras": [[camera.intrinsics[0].tolist(), camera.world_from_camera[0].tolist()] for camera in cameras],
            "others": [digest_of(view.rgb) for view in partners],
            "masks": digest_of(instances),
        }
        arrays = request.cache.get("depth", "stereo", settings, compute)
        depth = Depth(
            torch.from_numpy(arrays["depth"].astype(np.float32)), DepthTraits(metric=True, relative_error=0.02)
        )
        return Estimate(depth, f"with {len(partners)} other camera{'s' if len(partners) > 1 else ''}")
