"""Which points move as one rigid body, by what the video shows of them: parts are split, filled anew, given up."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.motion.to_video.alignment import Sightings, Video, align, carried_costs

_JUDGED_FRAMES = 24  # in which points are compared with the video
_NEIGHBOURS = 8  # that share in the choice of a point's part, ...
_SPREADS = 2  # ... so many times in a row
_SPLITS = 2  # times that every part is tried as two
_LEAST_POINTS = 40  # of a part
_WORTH = 0.005  # mean cost of an instance's points, that each of its parts must save


@dataclass(frozen=True)
class Grouping:
    """Rigid parts, and the part of every point."""

    part: Int[Tensor, " n"]
    motions: Float[Tensor, "k t 4 4"]  # float64
    tracked: Float[Tensor, "k t 4 4"]  # the same by tracks alone
    instance: Int[Tensor, " k"]
    active: Bool[Tensor, " k"]  # whether it moves

    def select(self, rows: Int[Tensor, " m"]) -> "Grouping":
        """Some of the parts, with all points where they were."""
        return Grouping(self.part, self.motions[rows], self.tracked[rows], self.instance[rows], self.active[rows])


def regroup(video: Video, points: Sightings, start: Grouping, max_parts: int) -> Grouping:
    """Parts and motions that explain the video best, in turn (docs/method.md, "Registration").

    Every part is halved, both halves are aligned and all points choose anew; then parts are given up, the least useful
    first, while that costs little or an instance has more than `max_parts`.
    """
    neighbours = _neighbours(points)
    found = aligned(video, points, aligned(video, points, start))
    for _ in range(_SPLITS):
        found = aligned(video, points, _halved(points, found))
        for _ in range(2):
            found = aligned(video, points, _chosen(_costs(video, points, found, neighbours), found))
        found = aligned(video, points, _pruned(_costs(video, points, found, neighbours), points, found, max_parts))
    for _ in range(2):
        found = aligned(video, points, _chosen(_costs(video, points, found, neighbours), found))
    return _chosen(_costs(video, points, found, neighbours), found)


def aligned(video: Video, points: Sightings, found: Grouping) -> Grouping:
    """Moving parts after some steps towards what the video shows, loosely held by their motions from tracks."""
    motions = align(video, points, found.part, found.motions, found.tracked)
    return replace(found, motions=torch.where(found.active[:, None, None, None], motions, found.motions))


def _neighbours(points: Sightings) -> Int[Tensor, "n j"]:
    """The nearest points of the same frame and instance, itself among them; again the same where these are few."""
    near = torch.zeros(len(points), _NEIGHBOURS, dtype=torch.long)
    keys = torch.stack((points.frame, points.instance), dim=1)
    for key in keys.unique(dim=0):
        rows = (keys == key).all(1).nonzero()[:, 0]
        count = min(_NEIGHBOURS, len(rows))
        nearest = torch.cdist(points.xyz[rows], points.xyz[rows]).topk(count, largest=False).indices
        near[rows] = rows[nearest][:, torch.arange(_NEIGHBOURS) % count]
    return near


def _costs(video: Video, points: Sightings, found: Grouping, neighbours: Int[Tensor, "n j"]) -> Float[Tensor, "n k"]:
    """Cost of each point in each part, smoothed over its neighbours; infinite in parts of other instances."""
    frames = evenly(len(video), _JUDGED_FRAMES)
    costs = carried_costs(video, points, found.motions, frames)
    for _ in range(_SPREADS):
        costs = (costs + costs[neighbours].mean(1)) / 2
    own = found.instance == points.instance[:, None]
    return torch.where(own | ~own.any(1, keepdim=True), costs, torch.inf)


def _chosen(costs: Float[Tensor, "n k"], found: Grouping) -> Grouping:
    """Every point in the part that suits it best."""
    return replace(found, part=costs.argmin(1))


def _halved(points: Sightings, found: Grouping) -> Grouping:
    """Every moving part cut in two across its longest side, if there are enough points."""
    at_canonical, _ = points.at_canonical(found.motions, found.part)
    part, parents = found.part.clone(), list(range(len(found.motions)))
    for k in range(len(found.motions)):
        rows = (found.part == k).nonzero()[:, 0]
        if not found.active[k] or len(rows) < 2 * _LEAST_POINTS:
            continue
        away = at_canonical[rows] - at_canonical[rows].mean(0)
        along = away @ torch.linalg.eigh(away.T @ away).eigenvectors[:, -1]
        part[rows[along > along.median()]] = len(parents)
        parents.append(k)
    return replace(found.select(torch.tensor(parents)), part=part)


def _pruned(costs: Float[Tensor, "n k"], points: Sightings, found: Grouping, max_parts: int) -> Grouping:
    """Without the parts that save too little; every instance keeps one at least, and `max_parts` at most."""
    labels = int(max(points.instance.max(), found.instance.max())) + 1
    of_instance = torch.bincount(points.instance, minlength=labels)[found.instance].clamp(min=1)
    kept = torch.ones(len(found.motions), dtype=torch.bool)
    while int(kept.sum()) > 1:
        best = torch.where(kept, costs, torch.inf).topk(2, dim=1, largest=False)
        own = best.indices[:, 0]
        loss = (best.values[:, 1] - best.values[:, 0]).nan_to_num(0.0, posinf=1.0)
        saved = torch.zeros(len(kept)).to(loss).index_add_(0, own, loss) / of_instance
        saved[torch.bincount(own, minlength=len(kept)) < _LEAST_POINTS] = 0
        siblings = torch.bincount(found.instance[kept], minlength=labels)[found.instance]
        useless = kept & (siblings > 1) & ((saved < _WORTH) | (siblings > max_parts))
        if not bool(useless.any()):
            break
        kept[torch.where(useless, saved, torch.inf).argmin()] = False
    rows = kept.nonzero()[:, 0]
    return replace(found.select(rows), part=costs[:, rows].argmin(1))
