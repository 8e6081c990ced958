"""Depth of single pictures by Depth Anything V2 (Yang et al., NeurIPS 2024), through transformers."""

from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.priors.hub import LocalModel

_BATCH = 4  # pictures


def predict_depth(rgb: UInt8[Tensor, "t h w 3"], model: LocalModel, device: str) -> tuple[Float[Tensor, "t h w"], bool]:
    """What the network says of every frame, and whether that is metric.

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
        found = processor.post_process_depth_estimation(outputs, target_sizes=[size] * len(part))
        frames += [item["predicted_depth"].float().cpu() for item in found]
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
