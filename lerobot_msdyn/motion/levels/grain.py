"""Grains: small regions of a primitive that move alike."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.registries import MOTION_LEVELS
from lerobot_msdyn.motion.finer.residual import ResidualTracks
from lerobot_msdyn.motion.from_tracks.clusters import displacement_features, filled, k_means
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.model.binding import nearest_bases
from lerobot_msdyn.motion.spec import Binding, FinerLevel

_FOLLOWED = 4  # grains that a point may follow ...
_PRIMITIVES = 2  # ... of so many primitives, those that it follows most
_IDLE = -4.0  # logit of following none; that of the nearest one is 0
_LEAST = 12  # tracks of a grain


@MOTION_LEVELS.register("grain")
class Grains(FinerLevel):
    """Tracks of a primitive, clustered by their displacements and their place."""

    after = ("primitive",)
    frames_per_knot = 4
    idle = True
    refines = True

    def cluster(self, tracks: ResidualTracks, config: MotionConfig, noise: float) -> Int[Tensor, " n"]:
        """By k-means."""
        positions = filled(tracks.positions, tracks.weights > 0)
        return k_means(displacement_features(tracks.points, positions), config.grains, _LEAST)

    def bind(
        self, level: MotionLevel, points: Float[Tensor, "n 3"], part: Int[Tensor, " n"], coarser: Binding | None
    ) -> Binding:
        """The nearest of two primitives, and a little of the identity, which stands last in the level."""
        assert coarser is not None
        primitives, weights = coarser
        heaviest = primitives.gather(1, weights.topk(min(_PRIMITIVES, weights.shape[1])).indices)
        index, logit = nearest_bases(level, points, heaviest, _FOLLOWED)
        idle = torch.full_like(index[:, :1], len(level) - 1)
        return torch.cat((index, idle), 1), torch.cat((logit, torch.full_like(logit[:, :1], _IDLE)), 1)
