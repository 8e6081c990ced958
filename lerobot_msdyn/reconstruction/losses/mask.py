"""Mean absolute difference between the rendered moving set and the mask of what moves (the paper's L_mask)."""

from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.core.registries import LOSSES
from lerobot_msdyn.reconstruction.loss_terms import FitStep


@LOSSES.register("mask")
def mask(step: FitStep) -> Float[Tensor, ""]:
    """Between the opacity of the moving set and the masks."""
    targets, frames = step.targets, step.frames
    certain = targets.certain[frames] if step.where is None else targets.certain[frames] & step.where
    return mask_loss(step.rendering.moving, targets.moves[frames], certain)


def mask_loss(
    rendered: Float[Tensor, "b h w"], moving: Bool[Tensor, "b h w"], certain: Bool[Tensor, "b h w"]
) -> Float[Tensor, ""]:
    """Mean absolute difference between the rendered opacity of what moves and the mask, where the mask is certain."""
    return ((rendered - moving.float()).abs() * certain).sum() / certain.sum().clamp(min=1)
