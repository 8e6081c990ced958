"""Which tracks move as one rigid body: an instance such as a robot arm is split where that clearly pays."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.motion.from_tracks.rigid import RigidFit, fit_rigid, model_points, refine, residuals
from lerobot_msdyn.render.cpu.threads import in_threads

_SEEDS = 32  # rigid motions that are tried per instance
_SEED_TRACKS = 16  # that propose one motion
_SEED_EFFECTIVE = 4.0  # effective number of tracks that a proposal needs at a frame
_TOLERANCE_PX = 2.0  # tracks that miss by less than this follow
_MIN_TOGETHER = 0.3  # of the clip, for which a part must be followed together with another one
_MIN_TRACKS = 8  # a part needs this many
_NEIGHBOURS = 8  # tracks that share in the choice of a track's part
_MIN_SHARED_FRAMES = 6  # in which two tracks must be seen together to be compared
_GROWTH_ROUNDS = 5  # in which a proposal takes in the tracks that follow it ...
_FOLLOWER_COST = 0.3  # ... up to this mean squared residual, in tolerances
_EM_ROUNDS = 6  # in which tracks and motions are refined in turn
_MAX_FRAMES = 60  # of the clip that are looked at
_MAX_TRACKS = 300  # of an instance that are looked at
_MIN_GAIN = 0.04  # of the cost of one rigid motion, that every further part must save
_GOOD_ENOUGH = 0.1  # mean cost of one rigid motion below which no split is tried
_MIN_TOTAL_GAIN = 0.3  # of the same, that the split as a whole must save


def split_rigid_parts(
    xyz: Float[Tensor, "n t 3"],
    valid: Bool[Tensor, "n t"],
    confidence: Float[Tensor, "n t"],
    instance: Int[Tensor, " n"],
    max_parts: int = 6,
    pixel_m: float = 0.0,
) -> Int[Tensor, " n"]:
    """Part of every track, numbered 0, 1, ... over all instances; the parts of an instance follow each other.

    For each instance many small groups of neighbouring tracks that keep their distances propose a rigid motion each;
    the few motions that together explain the tracks best are kept (greedy facility location), then tracks and motions
    are refined in turn. An instance stays whole unless the split explains it much better; residuals below two pixels,
    of `pixel_m` metres each at the distance of what moves, explain nothing. Parts must be seen together for a while:
    tracks of one body that end before others begin are no two parts.
    """

    def parts_of(rows: Int[Tensor, " m"]) -> Int[Tensor, " m"]:
        weights = torch.where(valid, confidence.square(), 0)[rows]
        return _split(xyz[rows], weights, max_parts, _TOLERANCE_PX * pixel_m)

    part = torch.full_like(instance, -1)
    instances = [(instance == label).nonzero()[:, 0] for label in instance.unique()]
    for rows, own in zip(instances, in_threads(parts_of, instances), strict=True):
        part[rows] = own + int(part.max()) + 1
    return part


@dataclass(frozen=True)
class _Tracks:
    """The tracks of one instance on a thinned time axis, and who is near whom."""

    xyz: Float[Tensor, "n t 3"]
    weights: Float[Tensor, "n t"]
    sample: Int[Tensor, " m"]  # the tracks, best seen ones first, that propose motions
    unlike: Float[Tensor, "n m"]  # how far from, and how loosely connected to, each of the sample; inf = never met
    neighbours: Int[Tensor, "n j"]  # indices into the sample


def _split(
    xyz: Float[Tensor, "n t 3"], weights: Float[Tensor, "n t"], max_parts: int, least_tolerance: float
) -> Int[Tensor, " n"]:
    """Part of every track of one instance, numbered from 0."""
    whole = torch.zeros(len(xyz), dtype=torch.long)
    if max_parts < 2 or len(xyz) < 2 * _MIN_TRACKS:
        return whole
    stride = -(-xyz.shape[1] // _MAX_FRAMES)
    tracks = _prepare(xyz[:, ::stride].double(), weights[:, ::stride].double())
    few = _sampled(tracks)
    fits, tolerance = _propose(few, least_tolerance)
    chosen = _choose(_costs(few, fits, tolerance), fits.support > 0, few.weights, max_parts)
    fit = RigidFit(fits.motions[chosen], fits.support[chosen])
    single = _total(_costs(tracks, fit, tolerance)[:1], tracks.weights)
    if len(chosen) == 1 or single < _GOOD_ENOUGH * float(tracks.weights.sum()):
        return whole
    part = _label(tracks, fit, tolerance)
    for _ in range(_EM_ROUNDS):
        fit = refine(tracks.xyz, _members(part, len(fit.motions)) * tracks.weights, fit)
        part = _label(tracks, fit, tolerance)
    gain = 1 - _total(_costs(tracks, fit, tolerance), tracks.weights) / single
    return part.unique(return_inverse=True)[1] if gain > _MIN_TOTAL_GAIN else whole


def _prepare(xyz: Float[Tensor, "n t 3"], weights: Float[Tensor, "n t"]) -> _Tracks:
    """Pairwise distances between tracks over the frames in which both are seen: their mean, and how much it varies."""
    sample = (weights > 0).sum(1).argsort(descending=True, stable=True)[:_MAX_TRACKS]
    total, square, count = torch.zeros(3, len(xyz), len(sample), dtype=xyz.dtype)
    for t in range(xyz.shape[1]):
        both = (weights[:, None, t] > 0) & (weights[None, sample, t] > 0)
        distance = torch.cdist(xyz[:, t], xyz[sample, t]) * both
        total, square, count = total + distance, square + distance.square(), count + both
    mean = total / count.clamp(min=1)
    spread = (square / count.clamp(min=1) - mean.square()).clamp(min=0).sqrt()
    met = count >= _MIN_SHARED_FRAMES
    near = torch.where(met, mean, torch.inf).topk(min(_NEIGHBOURS + 1, len(sample)), largest=False).indices
    reach, play = (values.gather(1, near).mean().clamp(min=1e-9) for values in (mean, spread))
    unlike = torch.where(met, mean / reach + spread / play, torch.inf)
    neighbours = unlike.topk(min(_NEIGHBOURS, len(sample)), largest=False).indices
    return _Tracks(xyz, weights, sample, unlike, neighbours)


def _sampled(tracks: _Tracks) -> _Tracks:
    """The sample alone."""
    rows = tracks.sample
    everyone = torch.arange(len(rows))
    return _Tracks(tracks.xyz[rows], tracks.weights[rows], everyone, tracks.unlike[rows], tracks.neighbours[rows])


def _propose(tracks: _Tracks, least_tolerance: float) -> tuple[RigidFit, float]:
    """Rigid motions of small groups of tracks, grown over all tracks that follow them; and a tolerance (m).

    The tolerance is three times the residual that tracks typically have under the proposal which suits them best.
    """
    seeds = _spread_out(tracks.unlike, min(_SEEDS, len(tracks.unlike)))
    nearest = tracks.unlike[seeds].topk(min(_SEED_TRACKS, len(tracks.unlike)), largest=False).indices
    members = torch.zeros(len(seeds), len(tracks.xyz), dtype=torch.bool).scatter_(1, nearest, True)
    members = torch.cat((members, torch.ones_like(members[:1])))  # and the instance as a whole
    fits = fit_rigid(tracks.xyz, members[..., None] * tracks.weights, refinements=1, min_effective=_SEED_EFFECTIVE)
    typical = float(_typical_residuals(tracks, fits).amin(0).nan_to_num(posinf=torch.nan).nanmedian())
    tolerance = max(3 * typical, least_tolerance, 1e-9)
    for _ in range(_GROWTH_ROUNDS):
        # judged by the frames that a proposal covers so far, so that it can grow into others
        followers = members | (_costs(tracks, fits, tolerance, only_covered=True) < _FOLLOWER_COST)
        fits = refine(tracks.xyz, followers[..., None] * tracks.weights, fits, _SEED_EFFECTIVE)
    return fits, tolerance


def _spread_out(unlike: Float[Tensor, "m m"], count: int) -> Int[Tensor, " count"]:
    """Farthest-point sampling, starting with the track that was seen best."""
    chosen = [0]
    nearest = unlike[0].clone()
    for _ in range(count - 1):
        chosen.append(int(torch.where(nearest.isinf(), -1.0, nearest).argmax()))
        nearest = torch.minimum(nearest, unlike[chosen[-1]])
    return torch.tensor(chosen)


def _typical_residuals(tracks: _Tracks, fits: RigidFit) -> Float[Tensor, "h n"]:
    """Root mean square residual (m) of every track under every motion that covers most of it; else infinite."""
    points, _ = model_points(tracks.xyz, tracks.weights, fits)
    weights = tracks.weights * (fits.support > 0)[:, None]
    covered = weights.sum(-1)
    square = (weights * residuals(tracks.xyz, points, fits).square()).sum(-1) / covered.clamp(min=1e-12)
    return torch.where(covered > 0.5 * tracks.weights.sum(-1), square.sqrt(), torch.inf)


def _costs(tracks: _Tracks, fits: RigidFit, tolerance: float, *, only_covered: bool = False) -> Float[Tensor, "h n"]:
    """Mean squared residual of every track under every motion, in tolerances and at most 1.

    A frame to which the motion does not extend costs 1; with `only_covered` such frames are left out, but a track needs
    some that are covered.
    """
    points, _ = model_points(tracks.xyz, tracks.weights, fits)
    covered = (fits.support > 0)[:, None]
    misfit = (residuals(tracks.xyz, points, fits) / tolerance).square().clamp(max=1)
    if not only_covered:
        misfit = torch.where(covered, misfit, 1.0)
        return (tracks.weights * misfit).sum(-1) / tracks.weights.sum(-1).clamp(min=1e-12)
    weights = tracks.weights * covered
    mean = (weights * misfit).sum(-1) / weights.sum(-1).clamp(min=1e-12)
    return torch.where((weights > 0).sum(-1) >= _MIN_SHARED_FRAMES, mean, 1.0)


def _total(cost: Float[Tensor, "h n"], weights: Float[Tensor, "n t"]) -> float:
    """Cost of the instance if every track follows the motion that suits it best."""
    return float((cost.amin(0) * weights.sum(1)).sum())


def _choose(
    cost: Float[Tensor, "h n"], covered: Bool[Tensor, "h t"], weights: Float[Tensor, "n t"], max_parts: int
) -> list[int]:
    """The few motions that together explain all tracks: the best one, then whichever saves most, while it pays."""
    mass = weights.sum(1)
    chosen = [int((cost * mass).sum(1).argmin())]
    single = best = float((cost[chosen[0]] * mass).sum())
    while len(chosen) < max_parts:
        totals = (torch.minimum(cost, cost[chosen].amin(0)) * mass).sum(1)
        together = (covered[:, None] & covered[None, chosen]).sum(-1).amax(1)
        totals[together < _MIN_TOGETHER * covered.shape[1]] = torch.inf
        if best - float(totals.min()) < _MIN_GAIN * single:
            break
        chosen.append(int(totals.argmin()))
        best = float(totals.min())
    return chosen


def _label(tracks: _Tracks, fit: RigidFit, tolerance: float) -> Int[Tensor, " n"]:
    """Part of every track: the motion that suits it and its neighbours; parts that are too small are given up."""
    cost = _costs(tracks, fit, tolerance)
    smooth = cost + cost[:, tracks.sample[tracks.neighbours]].mean(-1)
    part = smooth.argmin(0)
    size = torch.bincount(part, minlength=len(cost))
    part = torch.where(size[:, None] >= _MIN_TRACKS, smooth, torch.inf).argmin(0)
    return part


def _members(part: Int[Tensor, " n"], count: int) -> Bool[Tensor, "count n 1"]:
    return (part == torch.arange(count)[:, None])[..., None]
