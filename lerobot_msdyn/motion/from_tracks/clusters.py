"""Tracks that move alike: features of their motion and their place, and k-means."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_LLOYD_STEPS = 40
_WINDOWS = 15  # displacements that describe the direction of a track's motion over the clip
_DIRECTION_WEIGHT = 0.5  # of the directions, beside the place in units of the object's extent
_NOISE_SHARE = 3.0  # standard deviations of the noise, below which a displacement has no direction
_VECTOR_STEP = 4  # frames between the displacements that describe a track's motion in full
_VECTOR_WEIGHT = 0.3  # of these displacements ...
_PLACE_WEIGHT = 2.0  # ... beside the place
_LEAST = 1e-9


def filled(positions: Float[Tensor, "n t 3"], valid: Bool[Tensor, "n t"]) -> Float[Tensor, "n t 3"]:
    """Positions also where a track was not seen: linear inside a gap, held before the first and after the last.

    Meant for positions in the frame of the object: held in the world, they would show the object's own motion as a
    deformation.
    """
    frames = positions.shape[1]
    time = torch.arange(frames).expand(valid.shape)
    before = torch.where(valid, time, -1).cummax(dim=1).values
    after = torch.where(valid, time, frames).flip(1).cummin(dim=1).values.flip(1)
    start = torch.where(before < 0, after, before).clamp(max=frames - 1)
    end = torch.where(after >= frames, before, after).clamp(min=0)
    fraction = ((time - start) / (end - start).clamp(min=1)).clamp(0, 1)[..., None].to(positions)

    def at(index: Int[Tensor, "n t"]) -> Float[Tensor, "n t 3"]:
        return positions.gather(1, index[..., None].expand(-1, -1, 3))

    return torch.lerp(at(start), at(end), fraction)


def direction_features(
    points: Float[Tensor, "n 3"], positions: Float[Tensor, "n t 3"], noise: float
) -> Float[Tensor, "n f"]:
    """Directions of motion over some fifteenth of the clip each, and the place; what rests has no direction.

    Args:
        points: canonical points, m.
        positions: where they are at each frame, without gaps, m.
        noise: standard deviation of a position along one axis, m.
    """
    step = max(1, positions.shape[1] // _WINDOWS)
    sampled = positions[:, ::step]
    moved = sampled[:, 1:] - sampled[:, :-1]
    direction = moved / (moved.norm(dim=-1, keepdim=True) + _NOISE_SHARE * noise + _LEAST)
    scale = _DIRECTION_WEIGHT / max(direction.shape[1], 1) ** 0.5
    return torch.cat((scale * direction.flatten(1), _place(points)), dim=1)


def displacement_features(points: Float[Tensor, "n 3"], positions: Float[Tensor, "n t 3"]) -> Float[Tensor, "n f"]:
    """Displacements from the canonical points, whose size matters as well, and the place (both m)."""
    moved = positions[:, ::_VECTOR_STEP] - points[:, None]
    spread = (moved - moved.mean(0)).square().mean().sqrt().clamp(min=_LEAST)
    scale = _VECTOR_WEIGHT / moved.shape[1] ** 0.5
    return torch.cat((scale * (moved / spread).flatten(1), _PLACE_WEIGHT * _place(points)), dim=1)


def _place(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Points about their mean, in units of their root mean square distance from it."""
    centred = points - points.mean(0)
    return centred / centred.square().sum(-1).mean().sqrt().clamp(min=_LEAST)


def k_means(features: Float[Tensor, "n f"], count: int, least: int, seed: int = 0) -> Int[Tensor, " n"]:
    """Labels 0, 1, ... of at most `count` clusters of at least `least` members each (k-means++, Lloyd).

    A cluster that is too small is given up, the smallest first, and its members go to the nearest of the others.
    """
    n = len(features)
    if n == 0:
        return torch.zeros(0, dtype=torch.long)
    generator = torch.Generator().manual_seed(seed)
    centres = _far_apart(features, max(1, min(count, n // max(least, 1))), generator)
    label = torch.cdist(features, centres).argmin(1)
    for _ in range(_LLOYD_STEPS):
        centres = _means(features, label, centres)
        distance = torch.cdist(features, centres)
        new = distance.argmin(1)
        if torch.equal(new, label):
            break
        label = new
    size = torch.bincount(label, minlength=len(centres))
    kept = torch.ones(len(centres), dtype=torch.bool)
    while kept.sum() > 1 and int(size[kept].min()) < least:
        kept[torch.where(kept, size, n + 1).argmin()] = False
        label = torch.where(kept, torch.cdist(features, centres), torch.inf).argmin(1)
        size = torch.bincount(label, minlength=len(centres))
    return label.unique(return_inverse=True)[1]


def _far_apart(features: Float[Tensor, "n f"], count: int, generator: torch.Generator) -> Float[Tensor, "k f"]:
    """k-means++: each further centre is sampled in proportion to its squared distance from those before it."""
    chosen = [int(torch.randint(len(features), (1,), generator=generator))]
    nearest = (features - features[chosen[0]]).square().sum(-1)
    for _ in range(count - 1):
        if float(nearest.sum()) <= 0:
            break
        chosen.append(int(torch.multinomial(nearest, 1, generator=generator)))
        nearest = torch.minimum(nearest, (features - features[chosen[-1]]).square().sum(-1))
    return features[chosen]


def _means(
    features: Float[Tensor, "n f"], label: Int[Tensor, " n"], centres: Float[Tensor, "k f"]
) -> Float[Tensor, "k f"]:
    """Mean of every cluster; an empty one keeps its centre."""
    count = torch.bincount(label, minlength=len(centres))[:, None]
    total = torch.zeros_like(centres).index_add_(0, label, features)
    return torch.where(count > 0, total / count.clamp(min=1), centres)


def spread_nodes(points: Float[Tensor, "n 3"], count: int) -> Int[Tensor, " n"]:
    """The nearest to each point of at most `count` of the points, chosen far from each other; numbered from 0."""
    nodes = [0]
    nearest = (points - points[0]).square().sum(-1)
    for _ in range(min(count, len(points)) - 1):
        nodes.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (points - points[nodes[-1]]).square().sum(-1))
    return torch.cdist(points, points[nodes]).argmin(1).unique(return_inverse=True)[1]
