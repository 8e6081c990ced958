"""Mean absolute difference of colours 0..1 (the paper's L_rgb)."""

from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.registries import LOSSES
from lerobot_msdyn.reconstruction.loss_terms import FitStep


@LOSSES.register("rgb")
def rgb(step: FitStep) -> Float[Tensor, ""]:
    """Between the rendered and the recorded pictures."""
    return rgb_loss(step.rendering.rgb, step.targets.view.rgb[step.frames].float() / 255)


def rgb_loss(rendered: Float[Tensor, "b h w 3"], recorded: Float[Tensor, "b h w 3"]) -> Float[Tensor, ""]:
    """Mean absolute difference of colours 0..1."""
    return (rendered - recorded).abs().mean()
