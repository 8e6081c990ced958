"""What a loss term is given. The terms are files of their own in `losses/`, or a user's (docs/extending.md)."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.observations import Priors, View
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.rendering import Rendering


@dataclass(frozen=True)
class Targets:
    """What a video's frames should look like; all of them, on the device of the scene."""

    view: View  # at the size at which it is fitted
    priors: Priors  # at the same size
    moves: Bool[Tensor, "t h w"]
    certain: Bool[Tensor, "t h w"]  # where the mask can be trusted
    distance: float  # m, to the look-at point: the scene's unit of length

    def cropped(self, rows: slice, columns: slice) -> "Targets":
        """The same in some rows and columns alone, for terms that compare pixel by pixel."""
        window = (slice(None), rows, columns)
        priors = replace(self.priors, depth=self.priors.depth[window], instances=self.priors.instances[window])
        moves, certain = self.moves[window], self.certain[window]
        return replace(self, view=self.view.cropped(rows, columns), priors=priors, moves=moves, certain=certain)


@dataclass(frozen=True)
class FitStep:
    """One step of the fit: some frames as the scene shows them, the scene itself, and what was recorded."""

    scene: DynamicScene  # as it is optimised; its tensors carry gradients
    frames: Int[Tensor, " b"]  # that are compared
    rendering: Rendering  # of these frames, through the recorded camera; carries gradients
    targets: Targets  # in the rows and columns that are rendered
    random: torch.Generator  # for terms that draw; on the host
    backend: str = "auto"  # of the rasterizer, for terms that render
    where: Bool[Tensor, "b h w"] | None = None  # pixels that are rendered whole, and compared; none: all


LossTerm = Callable[[FitStep], Float[Tensor, ""]]  # unweighted; the weight is the recipe's


def certain_pixels(moving: Bool[Tensor, "t h w"], window: UInt8[ndarray, "k k"]) -> Bool[Tensor, "t h w"]:
    """Pixels around which a window of ones is all inside or all outside a mask: there the mask can be trusted."""
    masks = moving.numpy().astype(np.uint8)
    return torch.from_numpy(np.stack([(cv2.dilate(mask, window) == cv2.erode(mask, window)) for mask in masks]))
