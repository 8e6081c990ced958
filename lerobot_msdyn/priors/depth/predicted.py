"""What a network says of a video's frames, and of frames of all episodes of its camera; computed once and kept."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.priors.cache import PriorCache, open_cache
from lerobot_msdyn.priors.request import Request

MOST_ELSEWHERE = 16  # frames of all episodes

Predict = Callable[[UInt8[Tensor, "n h w 3"]], Float[Tensor, "n h w"]]


def predicted(
    request: Request, provider: str, settings: dict[str, Any], predict: Predict
) -> tuple[Float[Tensor, "t h w"], Float[Tensor, "m h w"] | None]:
    """Values of the video's frames, and of frames of all episodes of the camera where these are at hand.

    Args:
        request: the video.
        provider: the name under which values are kept.
        settings: what they depend on besides the pictures, as JSON.
        predict: runs the network.
    """
    own = _kept(request.cache, request.view.rgb, provider, settings, predict)
    if request.elsewhere is None:
        return own, None
    some = request.elsewhere[evenly(len(request.elsewhere), MOST_ELSEWHERE)]
    return own, _kept(open_cache(request.config.cache, some), some, provider, settings, predict)


def _kept(
    cache: PriorCache, rgb: UInt8[Tensor, "n h w 3"], provider: str, settings: dict[str, Any], predict: Predict
) -> Float[Tensor, "n h w"]:
    def compute() -> dict[str, np.ndarray]:
        values = predict(rgb).numpy()
        size = np.abs(values[np.isfinite(values)]).mean() if np.isfinite(values).any() else 0.0
        unit = float(size) or 1.0  # half floats hold what is about 1
        return {"values": (values / unit).astype(np.float16), "unit": np.array(unit)}

    arrays = cache.get("depth", provider, settings, compute)
    return torch.from_numpy(arrays["values"].astype(np.float32) * np.float32(arrays["unit"]))
