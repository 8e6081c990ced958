"""Depth as the dataset has it."""

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import DepthTraits
from lerobot_msdyn.priors.depth.flying_pixels import clean_recorded_depth
from lerobot_msdyn.priors.registry import DEPTH, Depth, DepthProvider, Estimate, Masks, Unusable
from lerobot_msdyn.priors.request import Request


@DEPTH.register("recorded")
class Recorded(DepthProvider):
    """The feature <camera>_depth, without what is no measurement."""

    rank = 50
    is_reference = True

    def usable(self, request: Request) -> str:
        """It is there."""
        if request.view.depth is None:
            raise Unusable("no depth is recorded", "the dataset has no <camera>_depth feature: use auto or plane")
        return "the dataset has it"

    def estimate(self, request: Request, instances: Masks) -> Estimate[Depth]:
        """Cleaned; everything that is measured is taken at its word."""
        if request.view.depth is None:
            raise PriorError("no depth is recorded")
        z = clean_recorded_depth(request.view.depth, *request.view.depth_range)
        if not bool((z > 0).any()):
            raise PriorError(
                f"the recorded depth of {request.key or 'the camera'} holds no measurement in any of its {len(z)} "
                "frames (all 0 or out of range); use --priors.depth plane"
            )
        return Estimate(Depth(z, DepthTraits(metric=True, sharp=True, relative_error=0.01)))
