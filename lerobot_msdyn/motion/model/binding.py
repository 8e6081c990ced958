"""Which bases a point follows, and how strongly: a few stored indices and logits per point and level."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.motion.model.bases import MotionLevel

NEGLIGIBLE = -30.0  # a logit that gives no weight
_CHUNK = 1 << 14  # points whose distances to all bases are held at a time


def nearest_bases(
    level: MotionLevel, points: Float[Tensor, "n 3"], parents: Int[Tensor, "n p"], count: int
) -> tuple[Int[Tensor, "n j"], Float[Tensor, "n j"]]:
    """The `count` bases nearest to each canonical point (m) of those whose parent is one of the point's `parents`.

    Nearness is the distance d from a basis' pivot, the logit -d^2 / (2 reach^2), relative to the nearest. Where there
    are fewer bases, the rest of a row has no weight.
    """
    j = min(count, len(level))
    indices = torch.zeros(len(points), j, dtype=torch.long)
    logits = torch.full((len(points), j), NEGLIGIBLE)
    for rows in torch.arange(len(points)).split(_CHUNK):
        allowed = (level.parents == parents[rows, :, None]).any(1)
        logit = -torch.cdist(points[rows], level.pivots).square() / (2 * level.reach.square())
        best, index = torch.where(allowed, logit, -torch.inf).topk(j, dim=1)
        indices[rows], logits[rows] = index, (best - best[:, :1]).clamp(min=NEGLIGIBLE)
    return indices, logits
