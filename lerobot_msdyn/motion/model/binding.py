"""Which bases a point follows, and how strongly: a few stored indices and logits per point and level."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.motion.model.bases import MotionLevel

NEGLIGIBLE = -30.0  # a logit that gives no weight
OTHER_INSTANCE = -4.0  # logit of a part of another instance, beside that for its distance
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


def nearest_parts(
    points: Float[Tensor, "n 3"],
    part: Int[Tensor, " n"],
    tracks: Float[Tensor, "m 3"],
    track_part: Int[Tensor, " m"],
    track_instance: Int[Tensor, " m"],
    count: int,
    reach: float,
) -> tuple[Int[Tensor, "n j"], Float[Tensor, "n j"]]:
    """Each canonical point's own rigid part and those with the nearest tracks, at most `count` of them.

    The logit of a part is -d^2 / (2 s^2), d being the distance (m) to its nearest track, 0 of the point's own part,
    and s the median size of the parts times `reach`; `OTHER_INSTANCE` less for parts of another instance.

    Args:
        points: canonical points, m.
        part: the part of each.
        tracks: tracked points at the canonical frame, m.
        track_part: the part of each track.
        track_instance: the instance of each track.
        count: parts that a point follows, at most.
        reach: in units of the root mean square distance of a part's tracks from their mean.
    """
    parts = int(max(part.max() if len(part) else 0, track_part.max())) + 1
    members = {k: tracks[track_part == k] for k in track_part.unique().tolist()}
    sizes = torch.stack([(own - own.mean(0)).square().sum(-1).mean().sqrt() for own in members.values()])
    scale = 2 * (reach * sizes.median()).square().clamp(min=1e-12)
    instance = torch.full((parts,), -1).scatter(0, track_part, track_instance.long())
    j = min(count, parts)
    indices, logits = torch.zeros(len(points), j, dtype=torch.long), torch.zeros(len(points), j)
    for rows in torch.arange(len(points)).split(_CHUNK):
        own = part[rows, None]
        squared = torch.full((len(rows), parts), torch.inf)
        for k, near in members.items():
            squared[:, k] = torch.cdist(points[rows], near).amin(1).square()
        logit = -squared / scale + OTHER_INSTANCE * (instance[None] != instance[own])
        best, indices[rows] = logit.scatter(1, own, torch.inf).topk(j, dim=1)
        logits[rows] = best.where(indices[rows] != own, 0.0).clamp(min=NEGLIGIBLE)
    return indices, logits
