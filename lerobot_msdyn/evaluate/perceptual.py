"""Perceptual differences by libraries of the extra `evaluate`: FLIP, which needs no weights, and LPIPS, which does.

FLIP: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020. LPIPS: Zhang et al., "The
Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018; AlexNet, version 0.1.
"""

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.priors.hub import has_library

INSTALL = "pip install 'lerobot_msdyn[evaluate]'"
ALEXNET = "alexnet-owt-7be5be79.pth"
_FETCH = "python -c \"from torchvision.models import alexnet; alexnet(weights='IMAGENET1K_V1')\""

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


def without_lpips() -> str:
    """Why LPIPS cannot be had, in one line; empty if it can."""
    if not has_library("lpips"):
        return f"mLPIPS is left out: lpips is not installed; {INSTALL}"
    path = Path(torch.hub.get_dir()) / "checkpoints" / ALEXNET
    return "" if path.is_file() else f"mLPIPS is left out: AlexNet's weights are not in {path}; fetch: {_FETCH}"


def lpips_network() -> SpatialNetwork:
    """LPIPS that gives a map; `without_lpips` says whether it can be had."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # lpips calls torchvision by names of old
        import lpips

        return lpips.LPIPS(net="alex", spatial=True, verbose=False).requires_grad_(False)


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
