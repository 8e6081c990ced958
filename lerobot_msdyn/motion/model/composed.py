"""Levels of motion that nobody learns, composed once for each frame: one map and one rotation carry each point."""

from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.motion.model.bases import MotionLevel, shares_of
from lerobot_msdyn.motion.model.carried import add_level, applied
from lerobot_msdyn.motion.model.compose import Level

MOST_BYTES = 1 << 27  # of maps that are remembered; further frames are composed whenever they are asked for
_BYTES = 64  # of the map and the rotation of a point


class ComposedLevel:
    """All levels of some points as one, on the CPU; files do not know it.

    The index of a point is its number among these points; its logit says nothing.
    """

    kind: ClassVar[str] = "composed"

    def __init__(
        self,
        levels: tuple[MotionLevel, ...],
        indices: tuple[Int[Tensor, "n _"], ...],
        logits: tuple[Float[Tensor, "n _"], ...],
        most_bytes: int = MOST_BYTES,
    ) -> None:
        """Levels from coarse to fine, what the points follow in each, and how much is remembered."""
        self.levels, self.indices, self.logits, self._most_bytes = levels, indices, logits, most_bytes
        self._known: dict[int, tuple[Tensor, Tensor]] = {}  # by frame

    def carry(
        self,
        positions: Float[Tensor, "b n 3"],
        orientations: Float[Tensor, "b n 4"],
        indices: Int[Tensor, "n 1"],
        logits: Float[Tensor, "n 1"],
        times: Float[Tensor, " b"] | Int[Tensor, " b"],
    ) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 4"]]:
        """As `Level.carry`."""
        maps, turns = self._at(indices[:, 0], times)
        return applied(maps, turns, positions, orientations)

    def carry_points(
        self,
        positions: Float[Tensor, "b n 3"],
        indices: Int[Tensor, "n 1"],
        logits: Float[Tensor, "n 1"],
        times: Float[Tensor, " b"] | Int[Tensor, " b"],
    ) -> Float[Tensor, "b n 3"]:
        """As `Level.carry_points`."""
        return self.carry(positions, positions.new_zeros(*positions.shape[:2], 4), indices, logits, times)[0]

    def _at(self, points: Int[Tensor, " n"], times: Tensor) -> tuple[Float[Tensor, "b n 12"], Float[Tensor, "b n 4"]]:
        """Maps, row by row, and rotations (wxyz) of some points at some times."""
        if times.is_floating_point():
            maps, turns = self._composed(times)
        else:
            known = [self._of_frame(frame) for frame in times.tolist()]
            maps, turns = known[0] if len(known) == 1 else (torch.cat(each) for each in zip(*known, strict=True))
        if len(points) == maps.shape[1] and bool((points == torch.arange(len(points))).all()):
            return maps, turns
        return maps[:, points], turns[:, points]

    def _of_frame(self, frame: int) -> tuple[Float[Tensor, "1 n 12"], Float[Tensor, "1 n 4"]]:
        known = self._known.get(frame)
        if known is None:
            known = self._composed(torch.tensor([frame]))
            if (len(self._known) + 1) * len(self.indices[0]) * _BYTES <= self._most_bytes:
                self._known[frame] = known
        return known

    @torch.no_grad()
    def _composed(self, times: Tensor) -> tuple[Float[Tensor, "b n 12"], Float[Tensor, "b n 4"]]:
        batch, count = len(times), len(self.indices[0])
        maps = torch.eye(3, 4).reshape(12).repeat(batch, count, 1)
        turns = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(batch, count, 1)
        for level, indices, logits in zip(*map(reversed, (self.levels, self.indices, self.logits)), strict=True):
            if bool(level.active.any()):
                add_level(level.affines(times), shares_of(logits), indices, maps, turns)
        return maps, turns


def composed_level(
    levels: Sequence[Level],
    indices: tuple[Int[Tensor, "n _"], ...],
    logits: tuple[Float[Tensor, "n _"], ...],
    most_bytes: int = MOST_BYTES,
) -> ComposedLevel | None:
    """All levels as one; None where they are learned, or not all of bases, or not in float32 on the CPU."""
    bases = tuple(level for level in levels if isinstance(level, MotionLevel))
    tensors = [*logits, *(values for level in bases for values in (level.rotations_6d, level.displacements))]
    usable = all(values.dtype == torch.float32 and values.device.type == "cpu" for values in tensors)
    if not bases or len(bases) < len(levels) or not usable or any(values.requires_grad for values in tensors):
        return None
    return ComposedLevel(bases, indices, logits, most_bytes)
