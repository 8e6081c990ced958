"""Perceptual differences by libraries of the extra `evaluate`: FLIP, which needs no weights, and LPIPS, which does.

FLIP: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020. LPIPS: Zhang et al., "The
Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018; AlexNet, version 0.1.
"""

import pickle
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.evaluate.asked import ALEXNET_FILE, unreadable_weights
from lerobot_msdyn.priors.hub import checkpoint, has_library
from lerobot_msdyn.priors.models import MODELS, how_to_fetch

INSTALL = "pip install 'lerobot_msdyn[evaluate]'"
ALEXNET = MODELS["alexnet"]
_SAVED = (
    'make a file for --lpips_weights where it is installed: python -c "import lpips, torch; '
    "torch.save(lpips.LPIPS(net='alex').net.state_dict(), 'alex.pt')\""
)
_FEATURE = re.compile(r"(slice[1-5]|features)\.\d+\.(weight|bias)$")
_SHAPES = {  # of AlexNet's convolutions, by layer
    "0.weight": (64, 3, 11, 11),
    "3.weight": (192, 64, 5, 5),
    "6.weight": (384, 192, 3, 3),
    "8.weight": (256, 384, 3, 3),
    "10.weight": (256, 256, 3, 3),
}

SpatialNetwork = Callable[[Tensor, Tensor], Tensor]  # [1, 3, h, w] of -1..1, twice -> [1, 1, h, w]


def without_flip() -> str:
    """Why FLIP cannot be had, in one line; empty if it can."""
    return "" if has_library("flip_evaluator") else f"FLIP is left out: flip-evaluator is not installed; {INSTALL}"


def masked_flip(rendered: UInt8[ndarray, "h w 3"], true: UInt8[ndarray, "h w 3"], mask: Bool[ndarray, "h w"]) -> float:
    """Mean FLIP over the mask, 0 (the same) .. 1, at the library's default of 67 pixels per degree.

    Pixels beside the mask count as well, as far as the eye's filters reach.
    """
    from flip_evaluator import evaluate

    images = (picture.astype(np.float32) / 255 for picture in (true, rendered))
    error, _, _ = evaluate(*images, "LDR", applyMagma=False, computeMeanError=False)
    return float(error[..., 0][mask].mean())


def without_lpips(weights: Path | None = None) -> str:
    """Why LPIPS cannot be had, in one line; empty if it can, or is to be had by a certain file."""
    if not has_library("lpips"):
        return f"mLPIPS is left out: lpips is not installed; {INSTALL}"
    path = checkpoint(ALEXNET.file)
    if weights is not None or path.is_file():
        return ""
    fetch = how_to_fetch(ALEXNET.place)
    return f"mLPIPS is left out: AlexNet's weights are not in {path}; fetch them with: {fetch}, or {_SAVED}"


def lpips_network(weights: Path | None = None) -> SpatialNetwork:
    """LPIPS that gives a map; `without_lpips` says whether it can be had.

    Args:
        weights: AlexNet's features; default: torchvision's checkpoint.

    Raises:
        ConfigError: the file cannot be read, or holds something else.
    """
    state = _features(checkpoint(ALEXNET.file) if weights is None else weights)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # lpips calls torchvision by names of old
        import lpips

        network = lpips.LPIPS(net="alex", spatial=True, pnet_rand=True, verbose=False)  # nothing is downloaded
    own = {name.split(".", 1)[1]: name for name in network.net.state_dict()}  # slice2.3.weight is of layer 3
    network.net.load_state_dict({own[name]: value for name, value in state.items()})
    return network.requires_grad_(False).eval()


def _features(path: Path) -> dict[str, Tensor]:
    """Weights of AlexNet's convolutions by layer: of lpips' own state (slice2.3.weight) or torchvision's."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, ValueError, pickle.UnpicklingError) as error:
        raise unreadable_weights(path, error) from error
    named = content.items() if isinstance(content, dict) else []
    parts = {name: value for name, value in named if isinstance(value, Tensor) and _FEATURE.match(str(name))}
    state = {".".join(name.split(".")[1:]): value for name, value in parts.items()}
    shapes = {name: tuple(value.shape) for name, value in state.items() if name.endswith("weight")}
    if shapes != _SHAPES or len(state) != 2 * len(_SHAPES):
        raise ConfigError(f"lpips_weights: {path} holds no AlexNet; expected {ALEXNET_FILE}")
    return state


def masked_lpips(
    rendered: UInt8[ndarray, "h w 3"],
    true: UInt8[ndarray, "h w 3"],
    mask: Bool[ndarray, "h w"] | Float[ndarray, "h w"],
    network: SpatialNetwork,
) -> float:
    """DyCheck's mLPIPS: pictures times the mask, as -1..1; the map's mean over the mask, 0 where that is empty."""
    weight = torch.from_numpy(mask.astype(np.float32))
    inputs = (2 * weight * torch.from_numpy(picture).movedim(-1, 0)[None] / 255 - 1 for picture in (rendered, true))
    with torch.no_grad():
        distance = network(*inputs)[0, 0]
    return float((distance * weight).sum() / weight.sum().clamp(min=1e-6))
