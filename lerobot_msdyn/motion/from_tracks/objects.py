"""The object level: the canonical frame, and one rigid motion per part from its tracks."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.geometry import invert_se3, transform_points
from lerobot_msdyn.motion.from_tracks.gaps import STILL, fill_gaps, find_carriers
from lerobot_msdyn.motion.from_tracks.rigid import fit_rigid, model_points
from lerobot_msdyn.motion.model.bases import MotionLevel, identity_level, level_from_motions


def canonical_frame(valid: Bool[Tensor, "n t"], instance: Int[Tensor, " n"]) -> int:
    """The frame in which the instances are seen best, each by its own measure, so that none yields to a larger one.

    Ties go to the frame with more tracks, then to the one nearest the middle of the clip.
    """
    frames = valid.shape[1]
    coverage = torch.zeros(frames, dtype=torch.float64)
    for label in instance.unique():
        seen = valid[instance == label].sum(0).double()
        coverage += seen / seen.max().clamp(min=1)
    total = valid.sum(0).double()
    middle = (torch.arange(frames) - (frames - 1) / 2).abs()
    ranking = sorted(range(frames), key=lambda t: (-round(coverage[t].item(), 9), -total[t].item(), middle[t].item()))
    return ranking[0]


def initialise_objects(
    xyz: Float[Tensor, "n t 3"],
    valid: Bool[Tensor, "n t"],
    confidence: Float[Tensor, "n t"],
    part: Int[Tensor, " n"],
    canonical: int,
    still_m: float = 0.0,
    frames_per_knot: int = 1,
) -> tuple[MotionLevel, Float[Tensor, "n 3"]]:
    """One basis per part, the identity at the canonical frame, and every track's point (m) at that frame.

    Where too few tracks support a part, it goes with the part that it moved with before (a held block with the
    gripper), or stands still. A part that is never supported, or that moves by less than `still_m` (root mean square
    over its points and frames), stands still altogether: its basis is inactive.
    """
    weights = torch.where(valid, confidence.square(), 0.0)
    rows = [(part == k).nonzero()[:, 0] for k in range(int(part.max()) + 1)] if len(part) else []
    fitted = [_fit_part(xyz[r], weights[r], None) for r in rows]
    if not fitted:
        return identity_level(torch.zeros(0, 3), xyz.shape[1]), torch.zeros(0, 3)
    motions, accepted = (torch.stack([getattr(f, name) for f in fitted]) for name in ("motions", "accepted"))
    carriers = find_carriers(motions, accepted, torch.stack([f.pivot for f in fitted]))
    points = torch.zeros(len(xyz), 3)
    # carriers are followed farther than what they carry, so they are completed first
    for k in sorted(range(len(rows)), key=lambda k: -int(accepted[k].sum())):
        carrier = int(carriers[k])
        carry = None if carrier == STILL else motions[carrier]
        fit = fitted[k] if carry is None else _fit_part(xyz[rows[k]], weights[rows[k]], carry)
        filled = fill_gaps(fit.motions, fit.accepted, fit.pivot, carry)
        motions[k] = filled @ invert_se3(filled[canonical])
        points[rows[k]] = _canonical_points(xyz[rows[k]], weights[rows[k]], motions[k], fit.accepted).float()
    pivots = torch.stack([points[r].mean(0) for r in rows])
    active = torch.tensor([_travel(motions[k], points[r]) > still_m for k, r in enumerate(rows)])
    return level_from_motions(
        motions.float(), pivots, active=active, frames_per_knot=frames_per_knot, canonical=canonical
    ), points


def _travel(motions: Float[Tensor, "t 4 4"], points: Float[Tensor, "n 3"]) -> float:
    """Root mean square displacement (m) of some points over all frames."""
    moved = transform_points(motions.float(), points.expand(len(motions), -1, -1)) - points
    return float(moved.square().sum(-1).mean().sqrt())


@dataclass(frozen=True)
class _PartFit:
    motions: Float[Tensor, "t 4 4"]  # from the part's own reference frame
    accepted: Bool[Tensor, " t"]
    pivot: Float[Tensor, "3"]  # m, at that frame


def _fit_part(
    xyz: Float[Tensor, "n t 3"], weights: Float[Tensor, "n t"], carry: Float[Tensor, "t 4 4"] | None
) -> _PartFit:
    fit = fit_rigid(xyz, weights[None], carry=None if carry is None else carry[None])
    points, observed = model_points(xyz, weights, fit)
    used = observed[0] if observed.any() else torch.ones_like(observed[0])
    return _PartFit(fit.motions[0], fit.support[0] > 0, points[0, used].mean(0))


def _canonical_points(
    xyz: Float[Tensor, "n t 3"],
    weights: Float[Tensor, "n t"],
    motions: Float[Tensor, "t 4 4"],
    accepted: Bool[Tensor, " t"],
) -> Float[Tensor, "n 3"]:
    """Tracks carried back, over the frames in which their part was followed; over all of them if that leaves none."""
    back = transform_points(invert_se3(motions), xyz.transpose(0, 1).double())
    followed = weights.double() * accepted
    used = torch.where(followed.sum(1, keepdim=True) > 0, followed, weights.double())
    return torch.einsum("nt,tnc->nc", used, back) / used.sum(1, keepdim=True).clamp(min=1e-12)
