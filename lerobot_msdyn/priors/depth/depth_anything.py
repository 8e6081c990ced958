"""Depth of single images by Depth Anything V2 (Yang et al., NeurIPS 2024), through transformers."""

from abc import abstractmethod
from dataclasses import replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.priors.depth.metres import in_metres
from lerobot_msdyn.priors.depth.predicted import predicted
from lerobot_msdyn.priors.exchange import AFFINE_DISPARITY, METRIC
from lerobot_msdyn.priors.hub import LocalModel
from lerobot_msdyn.priors.registry import Depth, DepthProvider, Estimate, Masks
from lerobot_msdyn.priors.request import Request

_BATCH = 4  # images


class DepthAnything(DepthProvider):
    """Its models of one kind."""

    kind: ClassVar[str]  # of what they predict, see `in_metres`

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

    def estimate(self, request: Request, instances: Masks) -> Estimate[Depth]:
        """Aligned to the best depth that needs no network, where it lacks true metres itself."""
        model = self.model(request)

        def predict(rgb: UInt8[Tensor, "n h w 3"]) -> Float[Tensor, "n h w"]:
            values, metric = predict_depth(rgb, model, request.device)
            kind = METRIC if metric else AFFINE_DISPARITY
            if kind != self.kind:
                raise PriorError(
                    f"{model.name} predicts {kind.replace('_', ' ')}; expected a model of {self.kind.replace('_', ' ')}"
                )
            return values

        settings = {"model": model.name, "revision": model.revision, "kind": self.kind}
        values, elsewhere = predicted(request, "depth_anything", settings, predict)
        estimate = in_metres(request, instances, values, self.kind, trusted=False, elsewhere=elsewhere)
        return replace(estimate, model=model)


def predict_depth(rgb: UInt8[Tensor, "t h w 3"], model: LocalModel, device: str) -> tuple[Float[Tensor, "t h w"], bool]:
    """What the network predicts of every frame, and whether that is metric.

    Metric: z-depth in metres of a camera like those of the network's training, so its scale is that of an unknown
    focal length. Relative: inverse depth up to a scale and a shift, larger = nearer.

    Raises:
        PriorError: the folder does not hold such a model.
    """
    processor, network = _load(model)
    network.to(device)
    size = tuple(rgb.shape[1:3])
    frames = []
    for part in rgb.split(_BATCH):
        inputs = processor(images=[frame.numpy() for frame in part.cpu()], return_tensors="pt").to(device)
        with torch.inference_mode():
            outputs = network(**inputs)
        sized = processor.post_process_depth_estimation(outputs, target_sizes=[size] * len(part))
        frames += [item["predicted_depth"].float().cpu() for item in sized]
    depth = torch.stack(frames)
    metric = network.config.depth_estimation_type == "metric"
    return (depth.clamp(min=0) if metric else depth), metric


def _load(model: LocalModel) -> tuple[Any, Any]:
    from transformers import AutoImageProcessor, DepthAnythingForDepthEstimation

    try:
        processor = AutoImageProcessor.from_pretrained(model.folder, local_files_only=True)
        network = DepthAnythingForDepthEstimation.from_pretrained(model.folder, local_files_only=True)
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise PriorError(
            f"{model.name} in {model.folder} is no Depth Anything model ({type(error).__name__})"
        ) from error
    return processor, network.eval()
