"""What stands where nobody has seen anything: continued from what is around, the farther surface before the nearer."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.config import Fill
from lerobot_msdyn.core.images import nearest_of
from lerobot_msdyn.views.coverage import HOLE_ALPHA

SOLID_ALPHA = 0.9  # from this opacity on a surface is drawn as it is; below, what is behind shines through
INPAINT_RADIUS_PX = 3
NEARER = 0.07  # share of its depth by which a surface beside a hole is nearer than the farthest there
MARGIN_PX = 3
MAX_REACH_PX = 21  # about a hole, in which surfaces are compared


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
        fill: inpaint (Telea 2004) or nearest (the nearest pixel's colour).
    """
    whole = (rgb / (alpha / SOLID_ALPHA).clamp(HOLE_ALPHA, 1)[..., None]).clamp(0, 1)
    holes = (alpha < HOLE_ALPHA).numpy()
    unusable = holes | _hiding(holes, depth.numpy())
    if unusable.all():
        unusable = holes
    if not holes.any() or holes.all():
        return whole
    picture = (whole * 255).round().to(torch.uint8).numpy()
    if fill == "nearest":
        continued = picture.reshape(-1, 3)[nearest_of(~unusable)]
    else:
        continued = cv2.inpaint(picture, unusable.astype(np.uint8), INPAINT_RADIUS_PX, cv2.INPAINT_TELEA)
    return torch.where(torch.from_numpy(holes)[..., None], torch.from_numpy(continued).float() / 255, whole)


def _hiding(holes: Bool[ndarray, "h w"], depth: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Known pixels beside holes that are nearer than others there: what hid the hole, and cannot continue it."""
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
