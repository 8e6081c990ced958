"""Masks by a video segmentation network that is shown what the weights-free masks have found."""

from abc import abstractmethod

import numpy as np
import torch

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.priors.cache import digest_of
from lerobot_msdyn.priors.hub import LocalModel
from lerobot_msdyn.priors.masks.providers.change import Change
from lerobot_msdyn.priors.masks.sam2 import sam2_masks
from lerobot_msdyn.priors.registry import Estimate, MaskProvider, Masks
from lerobot_msdyn.priors.request import Request


class PromptedMasks(MaskProvider):
    """SAM 2, or a network with its interface."""

    @abstractmethod
    def model(self, request: Request) -> LocalModel:
        """The model that the settings name.

        Raises:
            Unusable: it is not on this machine.
        """

    def usable(self, request: Request) -> str:
        """The model is there."""
        self.model(request)
        return "its model is on this machine"

    def estimate(self, request: Request) -> Estimate[Masks]:
        """The instances that were found without weights, with the network's outlines."""
        model, prompts = self.model(request), Change().estimate(request).value
        if not bool(prompts.any()):
            raise PriorError("it needs something that moves as a prompt, and the weights-free masks found nothing")

        def compute() -> dict[str, np.ndarray]:
            return {"masks": sam2_masks(request.view.rgb, prompts, model, request.device).numpy()}

        settings = {"model": model.name, "revision": model.revision, "shown": digest_of(prompts)}
        arrays = request.cache.get("masks", "prompted", settings, compute)
        return Estimate(torch.from_numpy(arrays["masks"]), model=model)
