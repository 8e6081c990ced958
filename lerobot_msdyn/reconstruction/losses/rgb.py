"""Mean absolute difference of colours 0..1 (the paper's L_rgb)."""

from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.core.registries import LOSSES
from lerobot_msdyn.reconstruction.loss_terms import FitStep


@LOSSES.register("rgb")
def rgb(step: FitStep) -> Float[Tensor, ""]:
    """Between the rendered and the recorded pictures."""
    return rgb_loss(step.rendering.rgb, step.targets.view.rgb[step.frames].float() / 255, step.where)


def rgb_loss(
    rendered: Float[Tensor, "b h w 3"], recorded: Float[Tensor, "b h w 3"], where: Bool[Tensor, "b h w"] | None = None
) -> Float[Tensor, ""]:
    """Mean absolute difference of colours 0..1, of some pixels or of all."""
    difference = (rendered - recorded).abs()
    if where is None:
        return difference.mean()
    return (difference.sum(-1) * where).sum() / (3 * where.sum()).clamp(min=1)
