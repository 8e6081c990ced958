"""The finer levels: what is left of the tracks' motion in the frame of their object, as bases close to the identity."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.geometry import nearest_rotation, se3
from lerobot_msdyn.motion.model.bases import MotionLevel, blend, identity_level, level_affines, level_from_motions

_MIN_EFFECTIVE = 6.0  # tracks behind a rotation: (sum w)^2 / sum w^2
_COLLINEAR = 0.05  # ratio of the second to the first extent of a set, below which it does not fix a rotation
_USUAL_TURN = 0.2  # rad, standard deviation of what is left to turn
_ROUNDS = 3  # of robust weights, each track following one basis
_SWEEPS = 8  # in which all bases are adapted to their blend
_NORMAL_MAD = 1.4826  # standard deviations in the median absolute deviation of a normal distribution
_MEDIAN_NORM = 1.538  # standard deviations in the median length of a normal 3D vector
_PAIRS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)  # of axes: the entries of a symmetric matrix ...
_OF_PAIRS = ((0, 1, 2), (1, 3, 4), (2, 4, 5))  # ... and which of these stands where
_HELD = 1e4  # weight of the identity at the canonical frame, against 1 for any other frame
_INVERTIBLE = 0.3  # smallest singular value of a blend that is inverted


@dataclass(frozen=True)
class ResidualTracks:
    """Tracks in the frame of the levels that are built already."""

    points: Float[Tensor, "n 3"]  # m, at the canonical frame
    positions: Float[Tensor, "n t 3"]  # m; meaningless where the weight is 0
    weights: Float[Tensor, "n t"]  # 0 = not seen
    part: Int[Tensor, " n"]
    owner: Int[Tensor, " n"]  # basis of the last level built, among whose tracks each was

    def select(self, rows: Tensor) -> "ResidualTracks":
        """Some of the tracks."""
        return ResidualTracks(
            self.points[rows], self.positions[rows], self.weights[rows], self.part[rows], self.owner[rows]
        )


@dataclass(frozen=True)
class _Followed:
    """How much each track counts for each basis, and times the moments of its canonical point."""

    shares: Float[Tensor, "n k"]
    squares: Float[Tensor, "k n"]
    moments: Float[Tensor, "k*4 n"]  # basis by basis: shares times 1, x, y, z ...
    all_moments: Float[Tensor, "k*10 n"]  # ... and times the six products of two coordinates

    @classmethod
    def of(cls, shares: Float[Tensor, "n k"], x: Float[Tensor, "n 3"]) -> "_Followed":
        """Of tracks at canonical points (m)."""
        at = shares[..., None] * x[:, None]  # [n,k,3]
        twice = at[..., _PAIRS[0]] * x[:, None, _PAIRS[1]]  # [n,k,6]
        first = torch.cat((shares[..., None], at), dim=-1)
        every = torch.cat((first, twice), dim=-1)
        return cls(shares, shares.square().T, first.flatten(1).T, every.flatten(1).T)


def cluster_places(
    points: Float[Tensor, "n 3"], label: Int[Tensor, " n"], parents: Int[Tensor, " k"], frames: int
) -> MotionLevel:
    """A level that does not move yet: one basis per cluster of canonical points (m), at its mean."""
    count = len(parents)
    size = torch.bincount(label, minlength=count).clamp(min=1)
    pivots = _sums(points, label, count) / size[:, None]
    reach = _medians((points - pivots[label]).norm(dim=-1), label, count).clamp(min=1e-6)
    still = identity_level(pivots, frames)
    return MotionLevel(still.rotations_6d, still.displacements, still.knots, pivots, reach, parents, still.active)


def solve_residual(
    places: MotionLevel,
    tracks: ResidualTracks,
    label: Int[Tensor, " n"],
    indices: Int[Tensor, "n j"],
    logits: Float[Tensor, "n j"],
    *,
    noise: float,
    shrink: bool = True,
    turn: bool = True,
) -> Float[Tensor, "k t 4 4"]:
    """The motion of every basis, from its tracks' canonical points to where the coarser levels leave them to go.

    Robust weighted Procrustes as at the object level, but pulled to the identity, the right prior for what is left over
    (see `_procrustes`). Too few or collinear tracks fix no rotation; frames without tracks copy the nearest one with
    some.

    First each track follows the basis of its cluster alone; then all bases are adapted to their blend. In each sweep a
    basis aims, for every track that follows it, at where it carries the track now plus what the blend misses. Because
    the weights of a track add up to one, no sweep can make the blend worse (Jensen's inequality).

    Args:
        places: pivots, reaches and parents of the bases.
        tracks: what is left of the tracks.
        label: cluster of every track.
        indices: bases that every track follows.
        logits: their weights before the softmax.
        noise: standard deviation of a position along one axis, m.
        shrink: whether rotations are pulled to the identity.
        turn: whether the bases turn as well as shift.
    """
    count, n = len(places), len(tracks.points)
    x, y, seen = tracks.points.double(), tracks.positions.double(), tracks.weights.double()
    alone = torch.nn.functional.one_hot(label, count).double()
    mix = torch.zeros_like(alone).scatter_add_(1, indices, torch.softmax(logits, dim=-1).double())
    motions = torch.eye(4, dtype=x.dtype).repeat(count, y.shape[1], 1, 1)
    for followed in [_Followed.of(alone, x)] * _ROUNDS + [_Followed.of(mix, x)] * _SWEEPS:
        maps = (followed.shares @ motions[..., :3, :].flatten(1)).reshape(n, y.shape[1], 3, 4)
        miss = y - (maps[..., :3] @ x[:, None, :, None])[..., 0] - maps[..., 3]
        typical = _typical(miss.norm(dim=-1), seen > 0, label, count).clamp(min=max(noise, 1e-9))
        trusted = seen / (1 + (miss.norm(dim=-1) / (_NORMAL_MAD * typical)[label, None]).square()).square()
        sigma = typical / _MEDIAN_NORM
        motions = _procrustes(followed, miss, trusted, motions, sigma if shrink else torch.zeros_like(sigma), turn)
    return motions


def smoothed_level(
    places: MotionLevel,
    motions: Float[Tensor, "k t 4 4"],
    *,
    canonical: int,
    smoothing: Float[Tensor, " k"],
    frames_per_knot: int = 1,
) -> MotionLevel:
    """The level of solved motions, through a second-difference (Whittaker) filter over time.

    Pivot displacements and rotations are filtered; the canonical frame is held at the identity. An infinite smoothing
    makes a basis the identity.
    """
    pivots = places.pivots.double()
    eye = torch.eye(3, dtype=motions.dtype)
    off = torch.cat((motions[..., :3, :3] - eye, (_apply(motions, pivots) - pivots[:, None])[..., None]), dim=-1)
    weight = torch.ones(motions.shape[1], dtype=motions.dtype)
    off[:, canonical], weight[canonical] = 0, _HELD
    smooth = torch.zeros_like(off)
    for strength in smoothing[smoothing.isfinite()].unique().tolist():
        rows = smoothing == strength
        smooth[rows] = whittaker(off[rows].flatten(2), weight, strength).reshape(off[rows].shape)
    rotation = nearest_rotation(smooth[..., :3] + eye)
    motions = se3(rotation, pivots[:, None] + smooth[..., 3] - (rotation @ pivots[:, None, :, None])[..., 0])
    motions[:, canonical] = torch.eye(4, dtype=motions.dtype)
    return level_from_motions(
        motions.to(places.pivots),
        places.pivots,
        reach=places.reach,
        parents=places.parents,
        active=places.active,
        frames_per_knot=frames_per_knot,
        canonical=canonical,
    )


def pull_back(
    level: MotionLevel,
    indices: Int[Tensor, "n j"],
    logits: Float[Tensor, "n j"],
    positions: Float[Tensor, "n t 3"],
) -> Float[Tensor, "n t 3"]:
    """Positions of tracks (m) before a level moved them; where its blend has no good inverse, by the heaviest basis."""
    if not bool(level.active.any()):
        return positions
    affines = level_affines(level, torch.arange(positions.shape[1])).to(positions)
    maps = blend(affines, indices, logits.to(positions)).transpose(0, 1)
    bad = torch.linalg.svdvals(maps[..., :3]).amin(-1) < _INVERTIBLE
    if bad.any():
        heaviest = affines[indices.gather(1, logits.argmax(dim=1, keepdim=True))[:, 0]]
        maps = torch.where(bad[..., None, None], heaviest, maps)
    return torch.linalg.solve(maps[..., :3], (positions - maps[..., 3])[..., None])[..., 0]


def _apply(motions: Float[Tensor, "n t 4 4"], x: Float[Tensor, "n 3"]) -> Float[Tensor, "n t 3"]:
    return (motions[..., :3, :3] @ x[:, None, :, None])[..., 0] + motions[..., :3, 3]


def _procrustes(
    followed: _Followed,
    miss: Float[Tensor, "n t 3"],
    weights: Float[Tensor, "n t"],
    motions: Float[Tensor, "k t 4 4"],
    sigma: Float[Tensor, " k"],
    turn: bool,
) -> Float[Tensor, "k t 4 4"]:
    """Rigid motions that carry points where the present ones do, plus what is missed; a point counts as it follows.

    A rotation has the prior of a small turn (standard deviation _USUAL_TURN about each axis): to the second moment is
    added sigma^2 / (n turn^2) times the identity, sigma (m) being the noise along one axis and n the points behind it.
    """
    count, frames = followed.shares.shape[1], weights.shape[1]
    moments = followed.all_moments @ weights
    total, x_mean, xx = moments.reshape(count, -1, frames).transpose(1, 2).split((1, 3, 6), dim=-1)
    safe = total.clamp(min=1e-12)
    x_mean, xx = x_mean / safe, (xx / safe)[..., _OF_PAIRS]
    missed = followed.moments @ (weights[..., None] * miss).flatten(1)
    missed = missed.reshape(count, 4, frames, 3).permute(0, 2, 3, 1) / safe[..., None]
    miss_mean, miss_x = missed[..., 0], missed[..., 1:]

    old, shift = motions[..., :3, :3], motions[..., :3, 3]
    y_mean = (old @ x_mean[..., None])[..., 0] + shift + miss_mean
    spread = xx - x_mean[..., :, None] * x_mean[..., None, :]
    rotation = torch.eye(3, dtype=miss.dtype).expand(count, frames, 3, 3)
    if turn:
        effective = total.square() / (followed.squares @ weights.square())[..., None].clamp(min=1e-12)
        extent = torch.linalg.eigvalsh(spread).clamp(min=0).sqrt()
        fixed = (effective[..., 0] >= _MIN_EFFECTIVE) & (extent[..., 1] > _COLLINEAR * extent[..., 2])
        prior = (sigma[:, None] / _USUAL_TURN).square() / effective[..., 0].clamp(min=1)
        wanted = old @ spread + miss_x - miss_mean[..., :, None] * x_mean[..., None, :]
        best = nearest_rotation(wanted + prior[..., None, None] * rotation)
        rotation = torch.where(fixed[..., None, None], best, rotation)
    solved = se3(rotation, y_mean - (rotation @ x_mean[..., None])[..., 0])
    return _nearest_solved(solved, total[..., 0] > 1e-9)


def _typical(
    distance: Float[Tensor, "n t"], seen: Bool[Tensor, "n t"], label: Int[Tensor, " n"], count: int
) -> Float[Tensor, " k"]:
    """Median over each cluster's tracks of their median residual (m)."""
    return _medians(torch.where(seen, distance, torch.nan).nanmedian(dim=1).values.nan_to_num(0.0), label, count)


def _nearest_solved(motions: Float[Tensor, "k t 4 4"], solved: Bool[Tensor, "k t"]) -> Float[Tensor, "k t 4 4"]:
    """Every frame that was not solved copies the nearest one that was; a basis without any does not move."""
    time = torch.arange(motions.shape[1])
    apart = (time[:, None] - time).abs()
    filled = motions.clone()
    for k in (~solved.all(1)).nonzero()[:, 0].tolist():
        known = solved[k].nonzero()[:, 0]
        if len(known):
            filled[k] = motions[k, known[apart[:, known].argmin(1)]]
        else:
            filled[k] = torch.eye(4, dtype=motions.dtype)
    return filled


def whittaker(
    values: Float[Tensor, "*batch t c"], weights: Float[Tensor, " t"], strength: float
) -> Float[Tensor, "*batch t c"]:
    """Series z that minimise sum w (z - value)^2 + strength . sum (second difference of z)^2."""
    frames = values.shape[-2]
    system = torch.diag(weights)
    if frames > 2:
        second = torch.diff(torch.eye(frames, dtype=values.dtype), n=2, dim=0)
        system = system + strength * second.T @ second
    return torch.linalg.solve(system, weights[:, None] * values)


def _sums(values: Float[Tensor, "n *_"], label: Int[Tensor, " n"], count: int) -> Float[Tensor, "k *_"]:
    return torch.zeros(count, *values.shape[1:], dtype=values.dtype).index_add_(0, label, values)


def _medians(values: Float[Tensor, " n"], label: Int[Tensor, " n"], count: int) -> Float[Tensor, " k"]:
    members = [values[label == k] for k in range(count)]
    return torch.stack([m.median() if len(m) else values.new_zeros(()) for m in members])
