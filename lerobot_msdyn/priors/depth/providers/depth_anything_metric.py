"""Depth Anything V2, the models that predict metres."""

from lerobot_msdyn.priors.depth.depth_anything import DepthAnything
from lerobot_msdyn.priors.exchange import METRIC
from lerobot_msdyn.priors.hub import LocalModel, local_model
from lerobot_msdyn.priors.registry import DEPTH
from lerobot_msdyn.priors.request import Request


@DEPTH.register("depth_anything_metric")
class DepthAnythingMetric(DepthAnything):
    """Predicts depth in the metres of an unknown focal length."""

    rank = 40
    kind = METRIC

    def model(self, request: Request) -> LocalModel:
        """That of `priors.depth_anything_metric_model`."""
        return local_model(request.config.depth_anything_metric_model)
