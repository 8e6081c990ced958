"""Mean absolute difference of inverse depth, relative to its mean (the paper's L_depth)."""

import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.registries import LOSSES
from lerobot_msdyn.reconstruction.loss_terms import FitStep


@LOSSES.register("depth")
def depth(step: FitStep) -> Float[Tensor, ""]:
    """Between the rendered depth and the prior's."""
    prior = step.targets.priors.depth[step.frames]
    known = prior if step.where is None else prior * step.where
    return depth_loss(step.rendering.depth, known, step.rendering.alpha)


def depth_loss(
    rendered: Float[Tensor, "b h w"], prior: Float[Tensor, "b h w"], alpha: Float[Tensor, "b h w"]
) -> Float[Tensor, ""]:
    """Mean absolute difference of inverse depth over its mean, where the prior (m, 0 = unknown) and a surface are."""
    valid = (prior > 0) & (alpha > 0.5) & (rendered > 0)
    target = torch.where(valid, prior, 1.0).reciprocal() * valid
    inverse = torch.where(valid, rendered, 1.0).reciprocal() * valid
    return (inverse - target).abs().sum() / target.sum().clamp(min=1e-12)
