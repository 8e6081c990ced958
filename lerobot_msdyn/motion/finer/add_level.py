"""Finer levels: built on what the coarser ones leave, kept where they prove themselves."""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.motion.finer.residual import (
    ResidualTracks,
    cluster_places,
    pull_back,
    smoothed_level,
    solve_residual,
)
from lerobot_msdyn.motion.from_tracks.lift import LiftedTracks
from lerobot_msdyn.motion.model.bases import MotionLevel, with_idle
from lerobot_msdyn.motion.model.compose import compose_points
from lerobot_msdyn.motion.model.scene_motion import SceneMotion, bind
from lerobot_msdyn.motion.spec import FinerLevel, finer_level, frames_per_knot
from lerobot_msdyn.render.cpu.threads import in_threads

_SMOOTHINGS = (1.0, 10.0, 100.0, 1000.0)  # of the bases over time, from which held-out tracks choose
_FOLDS = 3  # each third of the tracks judges a level that was fitted to the others
_LEAST_JUDGES = 8  # tracks, without which a level is refused
_CANONICAL_REACH = 4  # frames about the canonical one that do not judge
_QUERY_FRAMES = 8  # spread over the clip, from which judges are predicted ...
_QUERY_REACH = 4  # ... in frames farther away than this ...
_JUDGED_FRAMES = 60  # ... of so many
_WORTH = 0.01  # of the error, that a level must take away
_VISIBLE_PX = 0.3  # that a level must explain: less is not seen, and the drift of the tracks themselves
_SURE = 3.0  # standard errors that the gain must be: about ten pairs of part and level are judged per episode

Approve = Callable[[MotionLevel], Bool[Tensor, " p"]]  # parts in which a level agrees with the video


def add_level(
    name: str,
    tracks: ResidualTracks,
    seen: LiftedTracks,
    so_far: SceneMotion,
    config: MotionConfig,
    noise: float,
    approve: Approve | None = None,
) -> tuple[MotionLevel, ResidualTracks]:
    """The next level, and the tracks as it leaves them.

    Each third of the tracks judges a level that was fitted to the others (cross-validation). They choose how much each
    basis is smoothed over time, and, with `config.gate`, in which parts the level is kept: where it explains
    a visible motion of theirs, and surely so (`_proven`), and `approve` agrees; elsewhere its bases are inactive.
    """
    names, levels, canonical = (*so_far.names, name), so_far.levels, so_far.canonical_frame
    spec, every = finer_level(name), frames_per_knot(name, config)
    owner, parents = _clusters(spec, tracks, config, noise)
    places = cluster_places(tracks.points, owner, parents, tracks.positions.shape[1])
    if spec.idle:
        places = with_idle(places)
    fold = torch.arange(len(tracks.points)) % _FOLDS
    indices, logits = (each[-1] for each in bind(names, (*levels, places), tracks.points, tracks.part))

    def solved(rows: Bool[Tensor, " n"]) -> Float[Tensor, "k t 4 4"]:
        return solve_residual(
            places, tracks.select(rows), owner[rows], indices[rows], logits[rows], noise=noise, turn=spec.turns
        )

    def level(motions: Float[Tensor, "k t 4 4"], smoothing: Float[Tensor, " k"]) -> MotionLevel:
        return smoothed_level(places, motions, canonical=canonical, smoothing=smoothing, frames_per_knot=every)

    trials = [*in_threads(lambda k: solved(fold != k), range(_FOLDS))]
    gains = torch.zeros(len(_SMOOTHINGS), len(fold))
    for k, trial in enumerate(trials):
        for row, strength in enumerate(_SMOOTHINGS):
            uniform = level(trial, torch.full((len(places),), strength))
            judges = fold == k
            gains[row, judges] = _gain(uniform, indices[judges], logits[judges], tracks.select(judges), canonical)
    smoothing = _best_smoothing(gains, indices, logits, len(places))
    everywhere = torch.ones_like(fold, dtype=torch.bool)
    if not config.gate:
        fitted = level(solved(everywhere), smoothing)
    else:
        error, gain = torch.zeros(2, len(fold))

        def judged(k: int) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
            return _prediction(level(trials[k], smoothing), name, fold == k, tracks, seen, so_far)

        for k, values in enumerate(in_threads(judged, range(_FOLDS))):
            error[fold == k], gain[fold == k] = values
        proven = _proven(error, gain, tracks.part, _VISIBLE_PX * seen.pixel_m)
        if not bool(proven.any()):  # as most often
            still = torch.eye(4, dtype=torch.float64).expand(len(places), tracks.positions.shape[1], 4, 4)
            idle = level(still, torch.full((len(places),), torch.inf))
            return replace(idle, active=torch.zeros_like(idle.active)), replace(tracks, owner=owner)
        fitted = level(solved(everywhere), smoothing)
        if approve is not None:
            proven &= approve(fitted)[: len(proven)]
        kept = torch.zeros(len(fitted), dtype=torch.bool)
        kept[owner[proven[tracks.part]]] = True
        coarser = so_far.levels[-1]
        if spec.refines and isinstance(coarser, MotionLevel):
            kept &= coarser.active[fitted.parents.clamp(min=0)]
        fitted = replace(fitted, active=fitted.active & kept)
    return fitted, replace(tracks, positions=pull_back(fitted, indices, logits, tracks.positions), owner=owner)


def _clusters(
    spec: FinerLevel, tracks: ResidualTracks, config: MotionConfig, noise: float
) -> tuple[Int[Tensor, " n"], Int[Tensor, " k"]]:
    """The basis of every track, and the basis of the coarser level that carries each."""
    group = tracks.part if spec.of_parts else tracks.owner
    owner = torch.zeros_like(group)
    parents: list[int] = []
    for parent in group.unique().tolist():
        rows = (group == parent).nonzero()[:, 0]
        owner[rows] = spec.cluster(tracks.select(rows), config, noise) + len(parents)
        parents += [parent] * (int(owner[rows].max()) + 1 - len(parents))
    return owner, torch.tensor(parents)


def _gain(
    level: MotionLevel,
    indices: Int[Tensor, "n j"],
    logits: Float[Tensor, "n j"],
    tracks: ResidualTracks,
    canonical: int,
) -> Float[Tensor, " n"]:
    """By how much a level lowers the root mean square error (m) of each track."""
    times = torch.arange(tracks.positions.shape[1])
    moved = compose_points(tracks.points, (level,), (indices,), (logits,), times)
    weights = tracks.weights * ((times - canonical).abs() > _CANONICAL_REACH)
    still = _root_mean_square(tracks.points[:, None] - tracks.positions, weights)
    return still - _root_mean_square(moved.transpose(0, 1) - tracks.positions, weights)


def _root_mean_square(difference: Float[Tensor, "n t 3"], weights: Float[Tensor, "n t"]) -> Float[Tensor, " n"]:
    """Of the lengths of each row's vectors."""
    square = (weights * difference.square().sum(-1)).sum(1)
    return (square / weights.sum(1).clamp(min=1e-12)).sqrt()


def _best_smoothing(
    gains: Float[Tensor, "s n"], indices: Int[Tensor, "n j"], logits: Float[Tensor, "n j"], count: int
) -> Float[Tensor, " k"]:
    """For each basis the smoothing by which the tracks that follow it gain most; infinite where all lose."""
    follows = torch.zeros(len(indices), count).scatter_add_(1, indices, torch.softmax(logits, dim=-1))
    total = torch.cat((gains @ follows, torch.zeros(1, count)))
    return torch.tensor([*_SMOOTHINGS, torch.inf])[total.argmax(0)]


def _prediction(
    level: MotionLevel,
    name: str,
    judges: Bool[Tensor, " n"],
    tracks: ResidualTracks,
    seen: LiftedTracks,
    so_far: SceneMotion,
) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
    """How well a track is predicted in all other frames from where it was seen in one, and what a level adds to that.

    This is how Gaussians are gathered from the video, errors of the part that is chosen for a point included. Returns
    the root mean square error (m) without the level, and its gain by the level (not that of its square: the few tracks
    that are in a wrong part would outvote the others), averaged over the frames from which a track was predicted; not
    a number if there are none.
    """
    rest = ~judges
    if not bool(rest.any()):
        unknown = torch.full((int(judges.sum()),), torch.nan)
        return unknown, unknown
    without = replace(so_far, points=tracks.points[rest], part=tracks.part[rest], instance=seen.instance[rest])
    with_level = replace(without, names=(*so_far.names, name), levels=(*so_far.levels, level))
    rows = judges.nonzero()[:, 0]
    frames = seen.valid.shape[1]
    times = torch.arange(0, frames, -(-frames // _JUDGED_FRAMES))
    without_it, with_it, count = torch.zeros(3, len(rows))
    for frame in evenly(frames, _QUERY_FRAMES).tolist():
        here = (tracks.weights[rows, frame] > 0).nonzero()[:, 0]
        who = rows[here]
        weights = tracks.weights[who][:, times] * ((times - frame).abs() > _QUERY_REACH)
        for motion, total in ((without, without_it), (with_level, with_it)):
            points, part = motion.to_canonical(seen.xyz[who, frame], frame, seen.instance[who])
            moved = motion.moved_points(points, part, times)
            total[here] += _root_mean_square(moved.transpose(0, 1) - seen.xyz[who][:, times], weights)
        count[here] += 1
    return without_it / count, (without_it - with_it) / count


def _proven(
    error: Float[Tensor, " n"], gain: Float[Tensor, " n"], part: Int[Tensor, " n"], visible_m: float
) -> Bool[Tensor, " p"]:
    """Parts in which a level explains a visible motion, surely, and enough to matter."""
    proven = torch.zeros(int(part.max()) + 1 if len(part) else 0, dtype=torch.bool)
    for label in part.unique().tolist():
        judges = (part == label) & gain.isfinite()
        before, gains = error[judges], gain[judges]
        if len(gains) < _LEAST_JUDGES:
            continue
        explained = (before.square() - (before - gains).square()).mean()
        sure = gains.mean() > _SURE * gains.std() / len(gains) ** 0.5
        proven[label] = bool(sure & (gains.mean() > _WORTH * before.mean()) & (explained > visible_m**2))
    return proven
