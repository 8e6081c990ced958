"""Which bases a point follows, and how strongly: a few stored indices and logits per point and level."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.config import LevelName
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.model.compose import Level

PRIMITIVES = 5  # that a point may follow, all of its own object
GRAINS = 4  # that a point may follow ...
GRAIN_PRIMITIVES = 2  # ... of the nearest primitives
PARTICLES = 4  # that a point may follow
_IDLE = -4.0  # logit of not following any grain; that of the nearest one is 0
NEGLIGIBLE = -30.0  # a logit that gives no weight
_FLAT_SHARPNESS = 10.0  # logit lost per unit of distance from a flat basis (Shape of Motion)
_CHUNK = 1 << 14  # points whose distances to all bases are held at a time

Bindings = tuple[tuple[Int[Tensor, "n _"], ...], tuple[Float[Tensor, "n _"], ...]]  # indices and logits per level


def bind(
    names: tuple[LevelName, ...], levels: tuple[Level, ...], points: Float[Tensor, "n 3"], part: Int[Tensor, " n"]
) -> Bindings:
    """Indices and logits, per level, of canonical points (m) of known parts.

    A point follows its own part; the primitives of that part; the grains of the two nearest of these, or none at all
    (the last basis of a level of grains is the identity); particles of its part. Nearness is the distance d from a
    basis' pivot, the logit -d^2 / (2 reach^2), relative to the nearest.
    """
    indices: list[Tensor] = []
    logits: list[Tensor] = []
    for name, level in zip(names, levels, strict=True):
        index, logit = part[:, None], torch.zeros(len(part), 1)
        if name == "field":
            index, logit = index[:, :0], logit[:, :0]
        elif isinstance(level, MotionLevel) and name == "flat":
            index, logit = _flat(points, level)
        elif isinstance(level, MotionLevel) and name == "grain":
            nearest = indices[-1].gather(1, logits[-1].topk(min(GRAIN_PRIMITIVES, logits[-1].shape[1])).indices)
            index, logit = _grains(points, level, nearest)
        elif isinstance(level, MotionLevel) and name != "object":
            count = PRIMITIVES if name == "primitive" else PARTICLES
            index, logit = _nearest(points, level, part[:, None], count)
        indices.append(index)
        logits.append(logit)
    return tuple(indices), tuple(logits)


def _nearest(
    points: Float[Tensor, "n 3"], level: MotionLevel, parents: Int[Tensor, "n p"], count: int
) -> tuple[Int[Tensor, "n j"], Float[Tensor, "n j"]]:
    """The `count` nearest of the bases whose parent is one of those given; the rest of a row has no weight."""
    j = min(count, len(level))
    indices = torch.zeros(len(points), j, dtype=torch.long)
    logits = torch.full((len(points), j), NEGLIGIBLE)
    for some in torch.arange(len(points)).split(_CHUNK):
        allowed = (level.parents == parents[some, :, None]).any(1)
        logit = -torch.cdist(points[some], level.pivots).square() / (2 * level.reach.square())
        best, index = torch.where(allowed, logit, -torch.inf).topk(j, dim=1)
        indices[some], logits[some] = index, (best - best[:, :1]).clamp(min=NEGLIGIBLE)
    return indices, logits


def _grains(
    points: Float[Tensor, "n 3"], level: MotionLevel, primitives: Int[Tensor, "n p"]
) -> tuple[Int[Tensor, "n j"], Float[Tensor, "n j"]]:
    """The nearest grains, and a little of the identity, which stands last in the level."""
    index, logit = _nearest(points, level, primitives, GRAINS)
    idle = torch.full_like(index[:, :1], len(level) - 1)
    return torch.cat((index, idle), 1), torch.cat((logit, torch.full_like(logit[:, :1], _IDLE)), 1)


def _flat(points: Float[Tensor, "n 3"], level: MotionLevel) -> tuple[Int[Tensor, "n k"], Float[Tensor, "n k"]]:
    """All bases, by distance in units of the level's extent (the reach of its bases)."""
    index = torch.arange(len(level)).expand(len(points), -1)
    return index, -_FLAT_SHARPNESS * torch.cdist(points, level.pivots) / level.reach
