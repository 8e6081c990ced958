"""A flat low-rank basis: a few rigid motions that all points of the scene share (Shape of Motion's model).

A motion level of its own: `--plugins benchmarks/rivals/flat.py --motion.levels '[flat]'`.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.registries import MOTION_LEVELS
from lerobot_msdyn.motion.finer.residual import ResidualTracks, cluster_places, smoothed_level, solve_residual
from lerobot_msdyn.motion.from_tracks.clusters import direction_features, filled, k_means
from lerobot_msdyn.motion.model.bases import COARSEST, MotionLevel
from lerobot_msdyn.motion.spec import Binding, FirstLevel, PartTracks

_SMOOTHING = 1.0  # of the bases over time: they carry the whole motion, contacts included
_LEAST_TRACKS = 12  # of a basis
_SHARPNESS = 10.0  # logit lost per unit of distance from a basis (Shape of Motion)


@dataclass
class FlatSettings:
    """What `motion.settings.flat` may hold."""

    # Bases in the whole scene.
    bases: int = between(10, 1, 10_000)


@MOTION_LEVELS.register("flat")
class Flat(FirstLevel):
    """Bases over the whole scene, clustered by the directions of the tracks' motion and their place.

    Every point follows all of them, weighted by its distance from their pivots (Wang et al. 2024, section 3.2). They
    are solved like our finer levels are, blend included, but not drawn to the identity.
    """

    settings = FlatSettings

    def estimate(self, tracks: PartTracks, config: MotionConfig) -> MotionLevel:
        """By k-means and Procrustes."""
        points, count = tracks.points, config.settings_of("flat", FlatSettings).bases
        seen = filled(tracks.xyz, tracks.weights > 0)
        label = k_means(direction_features(points, seen, tracks.noise), count, _LEAST_TRACKS)
        parents = torch.full((int(label.max()) + 1,), COARSEST)
        places = cluster_places(points, label, parents, tracks.xyz.shape[1])
        extent = (points - points.mean(0)).norm(dim=-1).quantile(0.9).clamp(min=1e-6)
        places = replace(places, reach=extent.expand(len(places)).clone())
        indices, logits = self.bind(places, points, tracks.part, None)
        whole = ResidualTracks(points, tracks.xyz, tracks.weights, torch.zeros_like(label), label)
        motions = solve_residual(places, whole, label, indices, logits, noise=tracks.noise, shrink=False)
        smoothing = torch.full((len(places),), _SMOOTHING)
        return smoothed_level(places, motions, canonical=tracks.canonical, smoothing=smoothing)

    def bind(
        self, level: MotionLevel, points: Float[Tensor, "n 3"], part: Int[Tensor, " n"], coarser: Binding | None
    ) -> Binding:
        """All bases, by distance in units of the level's extent (the reach of its bases)."""
        index = torch.arange(len(level)).expand(len(points), -1)
        return index, -_SHARPNESS * torch.cdist(points, level.pivots) / level.reach
