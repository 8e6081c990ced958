"""A flat low-rank basis: a few rigid motions that all points of the scene share (Shape of Motion's model)."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.motion.finer.residual import ResidualTracks, cluster_places, smoothed_level, solve_residual
from lerobot_msdyn.motion.from_tracks.clusters import direction_features, filled, k_means
from lerobot_msdyn.motion.model.bases import COARSEST, MotionLevel
from lerobot_msdyn.motion.model.binding import bind

_SMOOTHING = 1.0  # of the bases over time: they carry the whole motion, contacts included
_LEAST_TRACKS = 12  # of a basis


def fit_flat(
    points: Float[Tensor, "n 3"],
    xyz: Float[Tensor, "n t 3"],
    weights: Float[Tensor, "n t"],
    count: int,
    canonical: int,
    noise: float,
) -> MotionLevel:
    """`count` bases over the whole scene, clustered by the directions of the tracks' motion and their place.

    Every point follows all of them, weighted by its distance from their pivots (Wang et al. 2024, section 3.2). They
    are solved like our finer levels are, blend included, but not drawn to the identity.

    Args:
        points: canonical points, m.
        xyz: where they were seen, m.
        weights: 0 = not seen.
        count: number of bases.
        canonical: the canonical frame.
        noise: standard deviation of a position along one axis, m.
    """
    part = torch.zeros(len(points), dtype=torch.long)
    label = k_means(direction_features(points, filled(xyz, weights > 0), noise), count, _LEAST_TRACKS)
    parents = torch.full((int(label.max()) + 1,), COARSEST)
    places = cluster_places(points, label, parents, xyz.shape[1])
    extent = (points - points.mean(0)).norm(dim=-1).quantile(0.9).clamp(min=1e-6)
    places = replace(places, reach=extent.expand(len(places)).clone())
    tracks = ResidualTracks(points, xyz, weights, part, label)
    indices, logits = bind(("flat",), (places,), points, part)
    motions = solve_residual(places, tracks, label, indices[0], logits[0], noise=noise, shrink=False)
    return smoothed_level(places, motions, canonical=canonical, smoothing=torch.full((len(places),), _SMOOTHING))
