"""EdgeTAM (Zhou et al., CVPR 2025)."""

from lerobot_msdyn.priors.hub import LocalModel, local_model
from lerobot_msdyn.priors.masks.prompted import PromptedMasks
from lerobot_msdyn.priors.models import MODELS
from lerobot_msdyn.priors.registry import MASKS
from lerobot_msdyn.priors.request import Request

# transformers builds EdgeTAM's default configuration when it loads a model, and reads this one's for it.
BACKBONE = MODELS["edgetam"].companion


@MASKS.register("edgetam")
class EdgeTam(PromptedMasks):
    """As `sam2`; smaller and faster."""

    rank = 30

    def model(self, request: Request) -> LocalModel:
        """That of `priors.edgetam_model`."""
        return local_model(request.config.edgetam_model, companion=BACKBONE)
