"""Depth Anything V2, the models that predict relative depth."""

from lerobot_msdyn.priors.depth.depth_anything import DepthAnything
from lerobot_msdyn.priors.exchange import AFFINE_DISPARITY
from lerobot_msdyn.priors.hub import LocalModel, local_model
from lerobot_msdyn.priors.registry import DEPTH
from lerobot_msdyn.priors.request import Request


@DEPTH.register("depth_anything")
class DepthAnythingRelative(DepthAnything):
    """Predicts relative inverse depth, brought to metres by other depth of the video."""

    rank = 30
    kind = AFFINE_DISPARITY

    def model(self, request: Request) -> LocalModel:
        """That of `priors.depth_anything_model`."""
        return local_model(request.config.depth_anything_model)
