"""Optical flow by RAFT (Teed and Deng, ECCV 2020), the small model of torchvision."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray
from safetensors.torch import load_file
from torch import Tensor

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.priors.hub import LocalModel, checkpoint, demand_library
from lerobot_msdyn.priors.models import MODELS, how_to_fetch
from lerobot_msdyn.priors.registry import Unusable

_NAME = "torchvision raft_small"
_MODEL = MODELS["raft"]
_MIN_SIDE, _MULTIPLE = 128, 8  # px: RAFT takes no smaller images, and sides that are multiples
_UPDATES = 12


def raft_weights(weights: Path | None) -> LocalModel:
    """The weights on this machine: the given file, else torchvision's own download.

    Raises:
        Unusable: they, or torchvision, are not on this machine.
    """
    demand_library("torchvision", "priors", "RAFT")
    if weights is not None:
        if not weights.is_file():
            raise Unusable(f"there is no {weights}", "priors.raft_weights names it")
        return LocalModel(_NAME, "local", _MODEL.licence, weights)
    path = checkpoint(_MODEL.file)
    if not path.is_file():
        raise Unusable("RAFT's weights are not on this machine", f"fetch: {how_to_fetch(_MODEL.place)}")
    return LocalModel(_NAME, path.stem, _MODEL.licence, path)


class RaftFlow:
    """Callable: two images -> the flow from the first to the second."""

    def __init__(self, model: LocalModel, device: str) -> None:
        from torchvision.models.optical_flow import raft_small

        self._network = raft_small(weights=None).eval()
        self._device = device
        try:
            if model.folder.suffix == ".safetensors":
                state = load_file(model.folder)
            else:
                state = torch.load(model.folder, map_location="cpu", weights_only=True)
            self._network.load_state_dict(state)
        except (OSError, ValueError, RuntimeError, EOFError, KeyError) as error:
            raise PriorError(
                f"priors.raft_weights: {model.folder} does not hold the weights of raft_small ({type(error).__name__})"
            ) from error
        self._network.to(self._device)

    @torch.inference_mode()
    def __call__(self, a: UInt8[ndarray, "h w 3"], b: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w 2"]:
        """Flow (px) from image `a` to image `b`, at their size."""
        height, width = a.shape[:2]
        flow = self._network(self._prepared(a), self._prepared(b), num_flow_updates=_UPDATES)[-1]
        return np.ascontiguousarray(flow[0, :, :height, :width].permute(1, 2, 0).cpu().numpy())

    def _prepared(self, image: UInt8[ndarray, "h w 3"]) -> Float[Tensor, "1 3 H W"]:
        """Colours -1..1, the borders repeated to a size that RAFT takes."""
        scaled = torch.from_numpy(image).permute(2, 0, 1)[None].float().to(self._device) / 127.5 - 1
        down, right = (_padding(side) for side in image.shape[:2])
        return torch.nn.functional.pad(scaled, (0, right, 0, down), mode="replicate")


def _padding(side: int) -> int:
    wanted = max(_MIN_SIDE, -(-side // _MULTIPLE) * _MULTIPLE)
    return wanted - side
