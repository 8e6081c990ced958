"""Loss terms of the fit: one small function each, unweighted; the weights are the recipe's."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor


def rgb_loss(drawn: Float[Tensor, "b h w 3"], recorded: Float[Tensor, "b h w 3"]) -> Float[Tensor, ""]:
    """Mean absolute difference of colours 0..1."""
    return (drawn - recorded).abs().mean()


def depth_loss(
    drawn: Float[Tensor, "b h w"], known: Float[Tensor, "b h w"], alpha: Float[Tensor, "b h w"]
) -> Float[Tensor, ""]:
    """Mean absolute difference of inverse depth over its mean, where depth (m, 0 = unknown) is known and drawn."""
    valid = (known > 0) & (alpha > 0.5) & (drawn > 0)
    target = torch.where(valid, known, 1.0).reciprocal() * valid
    found = torch.where(valid, drawn, 1.0).reciprocal() * valid
    return (found - target).abs().sum() / target.sum().clamp(min=1e-12)


def mask_loss(
    drawn: Float[Tensor, "b h w"], moving: Bool[Tensor, "b h w"], certain: Bool[Tensor, "b h w"]
) -> Float[Tensor, ""]:
    """Mean absolute difference between the drawn share of moving Gaussians and the mask, where the mask is certain."""
    return ((drawn - moving.float()).abs() * certain).sum() / certain.sum().clamp(min=1)


def certain_pixels(moving: Bool[Tensor, "t h w"], band: int) -> Bool[Tensor, "t h w"]:
    """Pixels further than `band` px from the border of a mask: there the mask can be trusted."""
    window = np.ones((2 * band + 1,) * 2, np.uint8)
    masks = moving.numpy().astype(np.uint8)
    return torch.from_numpy(np.stack([(cv2.dilate(mask, window) == cv2.erode(mask, window)) for mask in masks]))
