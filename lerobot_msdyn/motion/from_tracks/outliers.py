"""Tracks that their neighbours contradict: what has slipped to another surface is no deformation."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.motion.from_tracks.clusters import filled

_NEIGHBOURS = 8  # tracks of the same part that judge a track
_TOLERANCE = 3.0  # usual deviations from the neighbours, beyond which a position counts little
_CHUNK = 512  # tracks that are judged at a time


def coherence(
    points: Float[Tensor, "n 3"],
    positions: Float[Tensor, "n t 3"],
    valid: Bool[Tensor, "n t"],
    part: Int[Tensor, " n"],
    noise: float,
) -> Float[Tensor, "n t"]:
    """1 for positions that move as the tracks about them do, towards 0 for those that do not (Geman-McClure).

    The displacement of a track is compared with the median displacement of its nearest neighbours at the same time,
    in units of their own spread (where things bend, neighbours differ) or of the usual deviation in the part (noise),
    whichever is larger.

    Args:
        points: canonical points, m.
        positions: where they are in the frame of their part, m.
        valid: where they were seen.
        part: which part each belongs to.
        noise: standard deviation of a position along one axis, m.
    """
    moved = filled(positions, valid) - points[:, None]
    trust = torch.ones(valid.shape)
    for label in part.unique().tolist():
        rows = (part == label).nonzero()[:, 0]
        if len(rows) <= _NEIGHBOURS:
            continue
        deviation, spread = torch.zeros(2, len(rows), valid.shape[1])
        near = torch.cdist(points[rows], points[rows]).topk(_NEIGHBOURS + 1, largest=False).indices[:, 1:]
        for chunk in torch.arange(len(rows)).split(_CHUNK):
            around = moved[rows[near[chunk]]]
            middle = around.median(dim=1).values
            spread[chunk] = (around - middle[:, None]).norm(dim=-1).median(dim=1).values
            deviation[chunk] = (moved[rows[chunk]] - middle).norm(dim=-1)
        usual = deviation[valid[rows]].median() if bool(valid[rows].any()) else deviation.new_zeros(())
        scale = _TOLERANCE * torch.maximum(spread, usual.clamp(min=max(noise, 1e-9)))
        trust[rows] = 1 / (1 + (deviation / scale).square()).square()
    return trust
