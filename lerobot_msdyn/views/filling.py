"""Holes of a picture, where no frame has shown anything, continued from what is around them.

`filled` continues the farther surface rather than the nearer: for pictures that are written. `filled_softly` averages
what is around: several times as fast, for pictures that are rendered while a policy is trained, and for `fill: blur`.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.config import Fill
from lerobot_msdyn.core.images import nearest_of
from lerobot_msdyn.views.coverage import HOLE_ALPHA

SOLID_ALPHA = 0.9  # from this opacity on a surface is shown as it is; below, what is behind shines through
INPAINT_RADIUS_PX = 3  # of the grid: Telea's method continues lines from so near
NEARER = 0.07  # share of its depth by which a surface beside a hole is nearer than the farthest there
MARGIN_PX = 3
MAX_REACH_PX = 21  # about a hole, in which surfaces are compared
COARSER = 4  # soft filling works at a quarter of the size
SMALLEST_PX = 2  # its pyramid ends where a side is so short


def missing(alpha: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """How much of what is behind shines through: 1 where nothing is, 0 from `SOLID_ALPHA` on."""
    return ((SOLID_ALPHA - alpha) / SOLID_ALPHA).clamp(min=0)


def filled(
    rgb: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"], depth: Float[Tensor, "h w"], fill: Fill
) -> Float[Tensor, "h w 3"]:
    """A picture (0..1, over black) whose holes are filled, on the host.

    A hole beside an object is what the object hid: it is continued from the farther side, not from the object.

    Args:
        rgb: the picture.
        alpha: its opacity; below `HOLE_ALPHA` there is a hole.
        depth: its depth, m.
        fill: inpaint (Telea 2004), nearest (the nearest pixel's colour), blur (`filled_softly`) or noise (random
            colours, the same ones in every picture of a size).
    """
    whole = (rgb / (alpha / SOLID_ALPHA).clamp(HOLE_ALPHA, 1)[..., None]).clamp(0, 1)
    holes = (alpha < HOLE_ALPHA).numpy()
    if not holes.any() or holes.all():
        return whole
    unusable = holes | _hiding(holes, depth.numpy())
    if unusable.all():
        unusable = holes
    picture = (whole * 255).round().to(torch.uint8).numpy()
    if fill == "nearest":
        continued = picture.reshape(-1, 3)[nearest_of(~unusable)]
    elif fill == "blur":
        continued = filled_softly(picture.transpose(2, 0, 1), ~unusable).transpose(1, 2, 0)
    elif fill == "noise":
        continued = np.random.default_rng(0).integers(256, size=picture.shape, dtype=np.uint8)
    else:
        continued = cv2.inpaint(picture, unusable.astype(np.uint8), INPAINT_RADIUS_PX, cv2.INPAINT_TELEA)
    return torch.where(torch.from_numpy(holes)[..., None], torch.from_numpy(continued).float() / 255, whole)


def filled_softly(rgb: UInt8[ndarray, "3 h w"], opaque: Bool[ndarray, "h w"]) -> UInt8[ndarray, "3 h w"]:
    """A picture whose holes show what is around them, ever more coarsely (pull-push, Gortler et al. 1996).

    Args:
        rgb: the picture; what it shows in its holes does not matter.
        opaque: where there is no hole.
    """
    if opaque.all() or not opaque.any():
        return rgb
    mask = opaque.astype(np.uint8)
    height, width = opaque.shape
    coarse = (max(width // COARSER, 1), max(height // COARSER, 1))
    weighted = [cv2.resize(plane, coarse, interpolation=cv2.INTER_AREA) for plane in (rgb * mask).astype(np.float32)]
    weight = cv2.resize(mask.astype(np.float32), coarse, interpolation=cv2.INTER_AREA)
    pulled = _pulled(np.stack(weighted, axis=-1), weight).clip(0, 255).round().astype(np.uint8)
    around = [cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR) for plane in pulled.transpose(2, 0, 1)]
    return np.stack([cv2.copyTo(plane, mask, hidden) for plane, hidden in zip(rgb, around, strict=True)])


def _pulled(weighted: Float32[ndarray, "h w 3"], weight: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w 3"]:
    """Colours everywhere from colours times weights: where weights are missing, those of the next coarser image."""
    here = weighted / np.maximum(weight, 1e-6)[..., None]
    height, width = weight.shape
    if min(height, width) <= SMALLEST_PX:
        mean = weighted.sum((0, 1)) / max(float(weight.sum()), 1e-6)
        return np.where(weight[..., None] > 0, here, mean).astype(np.float32)
    coarser = _pulled(cv2.pyrDown(weighted), cv2.pyrDown(weight))
    below = cv2.resize(coarser, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(below + np.minimum(weight, 1)[..., None] * (here - below), np.float32)


def _hiding(holes: Bool[ndarray, "h w"], depth: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Pixels beside holes that are nearer than others there: what hid the hole, and cannot continue it."""
    inner = _inside(holes)
    if not inner.any():
        return np.zeros_like(holes)
    width = round(2 * float(cv2.distanceTransform(inner.astype(np.uint8), cv2.DIST_L2, 3).max()))
    reach = min(width + MARGIN_PX, MAX_REACH_PX)
    around, across = (np.ones((2 * size + 1,) * 2, np.uint8) for size in (reach, 2 * reach))
    farthest = cv2.dilate(np.where(holes, np.float32(0), depth.astype(np.float32)), across)
    beside = cv2.dilate(inner.astype(np.uint8), around) > 0
    return beside & ~holes & (depth < (1 - NEARER) * farthest)


def _inside(holes: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Holes that do not touch the border of the picture."""
    _, labels = cv2.connectedComponents(holes.astype(np.uint8))
    touching = np.unique(np.concatenate((labels[0], labels[-1], labels[:, 0], labels[:, -1])))
    return holes & ~np.isin(labels, touching[touching > 0])
