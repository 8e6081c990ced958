"""Particles: nodes spread over a rigid part that shift without turning (the paper's fourth level)."""

from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.registries import MOTION_LEVELS
from lerobot_msdyn.motion.finer.residual import ResidualTracks
from lerobot_msdyn.motion.from_tracks.clusters import spread_nodes
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.model.binding import nearest_bases
from lerobot_msdyn.motion.spec import Binding, FinerLevel

_FOLLOWED = 4  # particles that a point may follow, all of its own part


@MOTION_LEVELS.register("particle")
class Particles(FinerLevel):
    """Tracks of a part, each with the nearest of some nodes far from each other."""

    after = ("object", "primitive", "grain")
    frames_per_knot = 4
    of_parts = True
    turns = False

    def cluster(self, tracks: ResidualTracks, config: MotionConfig, noise: float) -> Int[Tensor, " n"]:
        """By the nearest node."""
        return spread_nodes(tracks.points, config.particles)

    def bind(
        self, level: MotionLevel, points: Float[Tensor, "n 3"], part: Int[Tensor, " n"], coarser: Binding | None
    ) -> Binding:
        """The nearest of its part."""
        return nearest_bases(level, points, part[:, None], _FOLLOWED)
