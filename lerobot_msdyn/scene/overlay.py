"""Gaussians of single frames: what the recorded camera shows at a time and the motion of the scene does not explain."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Float16, Int, UInt8
from torch import Tensor

from lerobot_msdyn.core.bits import packed_rows, unpacked

PATCH_OPACITY = 0.95  # of the Gaussians


@dataclass(frozen=True)
class FramePatch:
    """The Gaussians of one frame, and those of the scene's own that they replace."""

    means: Float[Tensor, "n 3"]  # m
    quats: Float[Tensor, "n 4"]  # wxyz
    log_scales: Float[Tensor, "n 3"]  # log of standard deviations in m
    rgb: Float[Tensor, "n 3"]  # 0..1
    hidden: Bool[Tensor, " g"]  # the scene's Gaussians, static ones first, that are not rendered
    short_lived: int = 0  # how many of them, the first ones, other frames show as well

    def __len__(self) -> int:
        return self.means.shape[0]


@dataclass(frozen=True)
class Overlay:
    """The patches of all frames, one behind the other; 32 bytes a Gaussian, and a bit for each of the scene's own.

    Of what is hidden, the scene's short-lived Gaussians that the frame shows come behind its others.
    """

    first: Int[Tensor, " t1"]  # frame i has the rows first[i] to first[i + 1]
    means: Float[Tensor, "n 3"]
    quats: Float16[Tensor, "n 4"]
    log_scales: Float16[Tensor, "n 3"]
    rgb: Float16[Tensor, "n 3"]
    hidden: UInt8[Tensor, "t bytes"]  # bits, most significant first

    def patch(self, frame: int, gaussians: int) -> FramePatch:
        """The patch of a frame of a scene with so many Gaussians of its own."""
        rows = self.rows(frame)
        return FramePatch(
            self.means[rows],
            self.quats[rows].float(),
            self.log_scales[rows].float(),
            self.rgb[rows].float(),
            unpacked(self.hidden[frame], gaussians),
        )

    def rows(self, frame: int) -> slice:
        """Where the Gaussians of a frame are."""
        return slice(self._first[frame], self._first[frame + 1])

    @cached_property
    def _first(self) -> list[int]:
        """`first` for indexing, asked of its device once."""
        return [int(row) for row in self.first.tolist()]


def packed(patches: list[FramePatch]) -> Overlay:
    """One overlay of the patches of all frames of a scene."""
    sizes = torch.tensor([0, *(len(patch) for patch in patches)])
    return Overlay(
        first=sizes.cumsum(0),
        means=torch.cat([patch.means for patch in patches]),
        quats=torch.cat([patch.quats for patch in patches]).to(torch.float16),
        log_scales=torch.cat([patch.log_scales for patch in patches]).to(torch.float16),
        rgb=torch.cat([patch.rgb for patch in patches]).to(torch.float16),
        hidden=packed_rows([patch.hidden for patch in patches]),
    )
