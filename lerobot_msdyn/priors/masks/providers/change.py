"""Masks without learned weights: what differs from a picture of the empty scene."""

from typing import Any

import numpy as np
import torch

from lerobot_msdyn.core.config import FIXED
from lerobot_msdyn.core.fields import AUTO
from lerobot_msdyn.priors.cache import digest_of
from lerobot_msdyn.priors.camera.steadiness import FIXED_PX, SWAY_PX
from lerobot_msdyn.priors.masks.moving import moving_instances, temporal_median
from lerobot_msdyn.priors.registry import MASKS, Estimate, MaskProvider, Masks
from lerobot_msdyn.priors.request import Request

CHANGE = "change"  # the name of the provider


@MASKS.register(CHANGE)
class Change(MaskProvider):
    """Can always be used."""

    rank = 10

    def estimate(self, request: Request) -> Estimate[Masks]:
        """Frames of other episodes of the same fixed camera help, where there are any."""
        rgb, elsewhere = request.view.rgb, request.elsewhere
        poses = request.camera.poses
        by_video = poses not in (AUTO, FIXED) and not request.camera.known_before(request.key or "")
        said_to_move = not request.view.camera.is_static or by_video
        sway_px = FIXED_PX if said_to_move else SWAY_PX

        def compute() -> dict[str, np.ndarray]:
            return {"masks": moving_instances(rgb, *temporal_median(rgb, elsewhere), elsewhere, sway_px).numpy()}

        settings: dict[str, Any] = {} if elsewhere is None else {"elsewhere": digest_of(elsewhere)}
        settings |= {"sway_px": sway_px} if said_to_move else {}
        arrays = request.cache.get("masks", "change", settings, compute)
        return Estimate(torch.from_numpy(arrays["masks"]))
