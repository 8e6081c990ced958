"""How much neighbours on a moving part shift relative to each other between two frames (the paper's L_rigid)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.geometry import quaternion_to_matrix
from lerobot_msdyn.core.registries import LOSSES
from lerobot_msdyn.motion.model.compose import compose
from lerobot_msdyn.motion.model.scene_motion import unturned
from lerobot_msdyn.reconstruction.loss_terms import FitStep
from lerobot_msdyn.scene.dynamic import DynamicScene

Neighbours = tuple[Int[Tensor, "a m"], Float[Tensor, "a n"]]  # each anchor and its neighbours; distances (m) of these

ANCHORS = 512  # Gaussians that are drawn
NEIGHBOURS = 8  # of each, the nearest ones of its part in the canonical frame
APART = (1, 3, 8)  # frames between the two that are compared, one of which is drawn
SMOOTH = 1e-3  # of the neighbours' usual distance, below which the loss is quadratic


@LOSSES.register("rigidity")
def rigidity(step: FitStep) -> Float[Tensor, ""]:
    """Mean over the step's frames, each against one that is drawn."""
    moving = len(step.scene.moving)
    if moving <= NEIGHBOURS or not step.scene.levels:
        return step.scene.moving.means.sum() * 0
    anchors = torch.randperm(moving, generator=step.random)[:ANCHORS].to(step.scene.device)
    neighbours = nearest_of_part(step.scene, anchors)
    losses = []
    for frame in step.frames.tolist():
        apart = APART[int(torch.randint(len(APART), (1,), generator=step.random))]
        other = frame + apart if frame + apart < step.scene.frames else max(frame - apart, 0)
        losses.append(rigidity_loss(step.scene, neighbours, torch.tensor([frame, other])))
    return torch.stack(losses).mean()


def rigidity_loss(scene: DynamicScene, neighbours: Neighbours, times: Int[Tensor, "2"]) -> Float[Tensor, ""]:
    """Mean of w |R_t^T (x_j - x_i)_t - R_t'^T (x_j - x_i)_t'| over neighbours j of anchors i, relative to distances.

    R is how an anchor has turned, w = exp(-d^2 / 2 s^2) by their canonical distance d, whose median is s; w and s are
    constants.
    """
    rows, distance = neighbours
    usual = distance.median().clamp(min=1e-12)
    chosen = scene.select_moving(rows.flatten())
    means, turns = compose(
        chosen.moving.means,
        unturned(len(chosen.moving)).to(chosen.moving.means),
        chosen.levels,
        chosen.indices,
        chosen.logits,
        times.to(scene.device),
    )
    means, turns = means.unflatten(1, rows.shape), turns.unflatten(1, rows.shape)
    back = quaternion_to_matrix(turns[:, :, 0]).transpose(-1, -2)[:, :, None]
    offset = (back @ (means[:, :, 1:] - means[:, :, :1])[..., None])[..., 0]
    change = (offset[0] - offset[1]) / usual
    length = (change.square().sum(-1) + SMOOTH**2).sqrt() - SMOOTH
    return (torch.exp(-(distance / usual).square() / 2) * length).mean()


@torch.no_grad()
def nearest_of_part(scene: DynamicScene, anchors: Int[Tensor, " a"]) -> Neighbours:
    """Anchors and the nearest Gaussians of each one's part in the canonical frame; where these are too few, itself."""
    means = scene.moving.means
    part = scene.indices[0].gather(1, scene.logits[0].argmax(1, keepdim=True))[:, 0]
    apart = torch.cdist(means[anchors], means).masked_fill(part[anchors, None] != part, torch.inf)
    apart[torch.arange(len(anchors), device=means.device), anchors] = torch.inf
    distance, near = apart.topk(NEIGHBOURS, dim=1, largest=False)
    near = near.where(distance.isfinite(), anchors[:, None])
    return torch.cat((anchors[:, None], near), dim=1), distance.nan_to_num(posinf=0.0)
