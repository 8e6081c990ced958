"""Rigid motions of groups of tracks: robust Procrustes over time, with tracks that come and go."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.core.geometry import invert_se3, transform_points, weighted_procrustes
from lerobot_msdyn.motion.from_tracks.sweep import NORMAL_MAD, swept

MIN_EFFECTIVE = 5.0  # tracks that a frame needs for its motion to be accepted: (sum w)² / sum w²
_NOISE_FLOOR = 1e-4  # of the group's extent: the smallest scale of the robust weights


@dataclass(frozen=True)
class RigidFit:
    """Motions of h groups over the clip, each relative to a reference frame of its own."""

    motions: Float[Tensor, "h t 4 4"]  # world points at the reference frame -> world points at t
    support: Float[Tensor, "h t"]  # effective number of tracks; 0 where the motion was not accepted


def fit_rigid(
    xyz: Float[Tensor, "n t 3"],
    weights: Float[Tensor, "h n t"],
    refinements: int = 8,
    min_effective: float = MIN_EFFECTIVE,
    carry: Float[Tensor, "h t 4 4"] | None = None,
) -> RigidFit:
    """Rigid motion of each of h groups; `weights` (0 = not a member, or not seen) say which tracks it may use.

    From the frame with most tracks outward, each frame is registered to a model of all tracks met so far, so that
    tracks need not share a frame (docs/motion.md, level 1). Then model and motions are refined in turn (generalised
    Procrustes analysis with missing data). All fits are robust (iterated Geman-McClure weights).

    `carry` is the motion of whatever carries a group while the group itself cannot be followed: with it, tracks that
    turn up after a gap join the model where the carrier has taken it.
    """
    fit = _sweep(xyz.double(), weights.double(), min_effective, carry)
    for _ in range(refinements):
        fit = refine(xyz, weights, fit, min_effective)
    return fit


def refine(
    xyz: Float[Tensor, "n t 3"],
    weights: Float[Tensor, "h n t"],
    fit: RigidFit,
    min_effective: float = MIN_EFFECTIVE,
) -> RigidFit:
    """One round of generalised Procrustes: the model given the motions, then the motions given the model."""
    xyz, weights = xyz.double(), weights.double()
    points, _ = model_points(xyz, weights, fit)
    usable = (weights * (fit.support > 0)[:, None]).transpose(1, 2)
    robust = _robust_weights(residuals(xyz, points, fit).transpose(1, 2), usable, _floor(xyz, weights)[:, None])
    points, seen = model_points(xyz, robust.transpose(1, 2), fit)

    source = points[:, None].expand(-1, xyz.shape[1], -1, -1)
    target = xyz.transpose(0, 1).expand(len(weights), -1, -1, -1)
    offered = weights.transpose(1, 2) * seen[:, None]
    # frames without a motion yet take part with plain weights: new members may now support them
    start = torch.where((fit.support > 0)[..., None], robust, offered)
    motions = weighted_procrustes(source, target, start)
    distance = (transform_points(motions, source) - target).norm(dim=-1)
    support = _effective(_robust_weights(distance, offered, _floor(xyz, weights)[:, None]))
    support = torch.where(support >= min_effective, support, 0.0)
    return RigidFit(torch.where((support > 0)[..., None, None], motions, fit.motions), support)


def model_points(
    xyz: Float[Tensor, "n t 3"], weights: Float[Tensor, "*#h n t"], fit: RigidFit
) -> tuple[Float[Tensor, "h n 3"], Bool[Tensor, "h n"]]:
    """Weighted mean of every track carried back to the reference frames (m), and whether it was seen at all."""
    xyz = xyz.double()
    weight = (weights * (fit.support > 0)[:, None]).transpose(1, 2)
    target = xyz.transpose(0, 1).expand(len(fit.motions), -1, -1, -1)
    back = transform_points(invert_se3(fit.motions), target)
    total = weight.sum(1)
    return torch.einsum("htn,htnc->hnc", weight.to(back), back) / total.clamp(min=1e-12)[..., None], total > 1e-9


def residuals(xyz: Float[Tensor, "n t 3"], points: Float[Tensor, "h n 3"], fit: RigidFit) -> Float[Tensor, "h n t"]:
    """Distance (m) of every track from where each group's motion puts it."""
    moved = transform_points(fit.motions, points[:, None].expand(-1, fit.motions.shape[1], -1, -1))
    return (moved - xyz.transpose(0, 1)).norm(dim=-1).transpose(1, 2)


def _sweep(
    xyz: Float[Tensor, "n t 3"],
    weights: Float[Tensor, "h n t"],
    min_effective: float,
    carry: Float[Tensor, "h t 4 4"] | None,
) -> RigidFit:
    """First motions: outward from each group's fullest frame, every frame against the model so far."""
    reference = (weights > 0).sum(1).argmax(1)
    return RigidFit(*swept(xyz, weights, reference, _floor(xyz, weights), min_effective, carry))


def _robust_weights(
    distance: Float[Tensor, "*batch n"], weights: Float[Tensor, "*batch n"], floor: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*batch n"]:
    """Geman-McClure weights; their scale is the median distance of the points that take part."""
    taking_part = torch.where(weights > 0, distance, torch.nan)
    scale = torch.maximum(NORMAL_MAD * taking_part.nanmedian(dim=-1).values.nan_to_num(0.0), floor)
    return weights / (1 + (distance / scale[..., None]).square()).square()


def _effective(weights: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
    return weights.sum(-1).square() / weights.square().sum(-1).clamp(min=1e-30)


def _floor(xyz: Float[Tensor, "n t 3"], weights: Float[Tensor, "h n t"]) -> Float[Tensor, " h"]:
    """Smallest scale (m) of the robust weights: a small part of the root mean square extent of each group."""
    total = weights.sum((1, 2)).clamp(min=1e-12)
    mean = torch.einsum("hnt,ntc->hc", weights, xyz) / total[:, None]
    square = torch.einsum("hnt,nt->h", weights, xyz.square().sum(-1)) / total
    return _NOISE_FLOOR * (square - mean.square().sum(-1)).clamp(min=1e-12).sqrt()
