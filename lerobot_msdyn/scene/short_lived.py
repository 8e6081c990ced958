"""Gaussians of a few frames: what motion leaves over of one frame, carried to those around it."""

from dataclasses import dataclass
from functools import cached_property

from jaxtyping import Bool, Float, Float16, Int, UInt8
from torch import Tensor

from lerobot_msdyn.core.bits import unpacked

STILL = -1  # carrier of what stands still


@dataclass(frozen=True)
class ShortLived:
    """Gaussians that are shown at some frames, each carried by the motion of one of the moving set, or standing still.

    36 bytes each and 4 for each frame that shows it, and a bit per frame for each of the scene's own.
    """

    means: Float[Tensor, "n 3"]  # m, at the canonical frame
    quats: Float16[Tensor, "n 4"]  # wxyz, likewise
    log_scales: Float16[Tensor, "n 3"]
    rgb: Float16[Tensor, "n 3"]
    carrier: Int[Tensor, " n"]  # of the moving set, or `STILL`
    first: Int[Tensor, " t1"]  # frame i shows the rows shown[first[i]:first[i + 1]]
    shown: Int[Tensor, " s"]
    hidden: UInt8[Tensor, "t bytes"]  # the scene's own Gaussians, static ones first, that are not rendered, as bits

    def rows(self, frame: int) -> Int[Tensor, " m"]:
        """Those that a frame shows."""
        return self.shown[self._first[frame] : self._first[frame + 1]].long()

    def hidden_at(self, frame: int, gaussians: int) -> Bool[Tensor, " g"]:
        """Which of so many Gaussians of the scene's own are not rendered at a frame."""
        return unpacked(self.hidden[frame], gaussians)

    @cached_property
    def _first(self) -> list[int]:
        """`first` for indexing, asked of its device once."""
        return [int(row) for row in self.first.tolist()]
