"""SAM 2 (Ravi et al., 2024)."""

from lerobot_msdyn.priors.hub import LocalModel, local_model
from lerobot_msdyn.priors.masks.prompted import PromptedMasks
from lerobot_msdyn.priors.registry import MASKS
from lerobot_msdyn.priors.request import Request


@MASKS.register("sam2")
class Sam2(PromptedMasks):
    """Better outlines than `change`, and follows what rests."""

    rank = 40

    def model(self, request: Request) -> LocalModel:
        """That of `priors.sam2_model`."""
        return local_model(request.config.sam2_model)
