"""Which points move as one rigid body, by what the video shows of them: parts are split, filled anew, given up."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.motion.to_video.alignment import Sightings, Video, align, carried_costs

_JUDGED_FRAMES = 24  # in which points are compared with the video
_NEIGHBOURS = 8  # that take part in the choice of a point's part, ...
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


def regroup(video: Video, points: Sightings, start: Grouping, max_parts: int, known: int = 0) -> Grouping:
    """Parts and motions that explain the video best, in turn (docs/motion.md, "Registration").

    Every part is halved, both halves are aligned and all points choose anew; then parts are given up, the least useful
    first, while that costs little or an instance has more than `max_parts`. Those of the instance `known` (0: none)
    stay, and their motions too.
    """
    neighbours = _neighbours(points)

    def aligned_again(grouping: Grouping) -> Grouping:
        return aligned(video, points, grouping, known)

    grouping = aligned_again(aligned_again(start))
    for _ in range(_SPLITS):
        grouping = aligned_again(_halved(points, grouping, known))
        for _ in range(2):
            grouping = aligned_again(_chosen(_costs(video, points, grouping, neighbours), grouping))
        costs = _costs(video, points, grouping, neighbours)
        grouping = aligned_again(_pruned(costs, points, grouping, max_parts, known))
    for _ in range(2):
        grouping = aligned_again(_chosen(_costs(video, points, grouping, neighbours), grouping))
    return _chosen(_costs(video, points, grouping, neighbours), grouping)


def aligned(video: Video, points: Sightings, grouping: Grouping, known: int = 0) -> Grouping:
    """Moving parts after some steps towards what the video shows, loosely held by their motions from tracks."""
    motions = align(video, points, grouping.part, grouping.motions, grouping.tracked)
    free = grouping.active & (grouping.instance != known)
    return replace(grouping, motions=torch.where(free[:, None, None, None], motions, grouping.motions))


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


def _costs(video: Video, points: Sightings, grouping: Grouping, neighbours: Int[Tensor, "n j"]) -> Float[Tensor, "n k"]:
    """Cost of each point in each part, smoothed over its neighbours; infinite in parts of other instances."""
    frames = evenly(len(video), _JUDGED_FRAMES)
    costs = carried_costs(video, points, grouping.motions, frames)
    for _ in range(_SPREADS):
        costs = (costs + costs[neighbours].mean(1)) / 2
    same_instance = grouping.instance == points.instance[:, None]
    return torch.where(same_instance | ~same_instance.any(1, keepdim=True), costs, torch.inf)


def _chosen(costs: Float[Tensor, "n k"], grouping: Grouping) -> Grouping:
    """Every point in the part that suits it best."""
    return replace(grouping, part=costs.argmin(1))


def _halved(points: Sightings, grouping: Grouping, known: int) -> Grouping:
    """Every moving part cut in two across its longest side, if there are enough points."""
    at_canonical, _ = points.at_canonical(grouping.motions, grouping.part)
    part, parents = grouping.part.clone(), list(range(len(grouping.motions)))
    for k in range(len(grouping.motions)):
        rows = (grouping.part == k).nonzero()[:, 0]
        if not grouping.active[k] or len(rows) < 2 * _LEAST_POINTS or int(grouping.instance[k]) == known:
            continue
        away = at_canonical[rows] - at_canonical[rows].mean(0)
        along = away @ torch.linalg.eigh(away.T @ away).eigenvectors[:, -1]
        part[rows[along > along.median()]] = len(parents)
        parents.append(k)
    return replace(grouping.select(torch.tensor(parents)), part=part)


def _pruned(costs: Float[Tensor, "n k"], points: Sightings, grouping: Grouping, max_parts: int, known: int) -> Grouping:
    """Without the parts that save too little; every instance keeps one at least, and `max_parts` at most."""
    labels = int(max(points.instance.max(), grouping.instance.max())) + 1
    of_instance = torch.bincount(points.instance, minlength=labels)[grouping.instance].clamp(min=1)
    kept = torch.ones(len(grouping.motions), dtype=torch.bool)
    while int(kept.sum()) > 1:
        best = torch.where(kept, costs, torch.inf).topk(2, dim=1, largest=False)
        chosen = best.indices[:, 0]
        loss = (best.values[:, 1] - best.values[:, 0]).nan_to_num(0.0, posinf=1.0)
        saved = torch.zeros(len(kept)).to(loss).index_add_(0, chosen, loss) / of_instance
        saved[torch.bincount(chosen, minlength=len(kept)) < _LEAST_POINTS] = 0
        siblings = torch.bincount(grouping.instance[kept], minlength=labels)[grouping.instance]
        useless = kept & (grouping.instance != known) & (siblings > 1) & ((saved < _WORTH) | (siblings > max_parts))
        if not bool(useless.any()):
            break
        kept[torch.where(useless, saved, torch.inf).argmin()] = False
    rows = kept.nonzero()[:, 0]
    return replace(grouping.select(rows), part=costs[:, rows].argmin(1))
