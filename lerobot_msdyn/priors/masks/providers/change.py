"""Masks without learned weights: what differs from a picture of the empty scene."""

import numpy as np
import torch

from lerobot_msdyn.priors.cache import digest_of
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

        def compute() -> dict[str, np.ndarray]:
            return {"masks": moving_instances(rgb, *temporal_median(rgb, elsewhere), elsewhere).numpy()}

        settings = {} if elsewhere is None else {"elsewhere": digest_of(elsewhere)}
        arrays = request.cache.get("masks", "change", settings, compute)
        return Estimate(torch.from_numpy(arrays["masks"]))
