"""Where the Gaussians are at a time: the finest motion first, then the coarser ones that carry it (docs/motion.md)."""

from typing import ClassVar, Protocol, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor


@runtime_checkable
class Level(Protocol):
    """An estimated level of motion: a frozen dataclass of tensors that carries points."""

    kind: ClassVar[str]  # names the class in files of scenes: the level that registers it, "bases" for `MotionLevel`

    def carry(
        self,
        positions: Float[Tensor, "b n 3"],
        orientations: Float[Tensor, "b n 4"],
        indices: Int[Tensor, "n j"],
        logits: Float[Tensor, "n j"],
        times: Float[Tensor, " b"] | Int[Tensor, " b"],
    ) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 4"]]:
        """Positions (m) and orientations (wxyz) moved by the bases that each point names, at the times of the batch."""

    def carry_points(
        self,
        positions: Float[Tensor, "b n 3"],
        indices: Int[Tensor, "n j"],
        logits: Float[Tensor, "n j"],
        times: Float[Tensor, " b"] | Int[Tensor, " b"],
    ) -> Float[Tensor, "b n 3"]:
        """Positions (m) as `carry` moves them, without orientations."""


def compose(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    levels: tuple[Level, ...],
    indices: tuple[Int[Tensor, "n _"], ...],
    logits: tuple[Float[Tensor, "n _"], ...],
    times: Float[Tensor, " b"] | Int[Tensor, " b"],
) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 4"]]:
    """Means (m) and orientations (wxyz) of Gaussians at some times (frames), differentiable in all but the indices.

    T = T1 . T2 . T3, the paper's hierarchy: `levels` go from coarse to fine, and the finest is applied first, so that
    it is carried by the coarser ones. A Gaussian follows, in each level, the few bases in its row of `indices`, mixed
    by softmax(`logits`): the cost does not depend on how many bases there are. Affine maps are mixed, not rotations
    and translations apart, so that a position does not depend on where the pivots or the world's origin lie; the mixed
    map is projected to a rotation for the orientation alone.
    """
    positions = means.expand(len(times), -1, -1)
    orientations = quats.expand(len(times), -1, -1)
    for level, index, logit in zip(reversed(levels), reversed(indices), reversed(logits), strict=True):
        positions, orientations = level.carry(positions, orientations, index, logit, times)
    return positions, orientations


def compose_points(
    means: Float[Tensor, "n 3"],
    levels: tuple[Level, ...],
    indices: tuple[Int[Tensor, "n _"], ...],
    logits: tuple[Float[Tensor, "n _"], ...],
    times: Float[Tensor, " b"] | Int[Tensor, " b"],
) -> Float[Tensor, "b n 3"]:
    """The means (m) of `compose` alone, in a fraction of its time."""
    positions = means.expand(len(times), -1, -1)
    for level, index, logit in zip(reversed(levels), reversed(indices), reversed(logits), strict=True):
        positions = level.carry_points(positions, index, logit, times)
    return positions
