"""Primitives: regions of a rigid part that move alike."""

from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.registries import MOTION_LEVELS
from lerobot_msdyn.motion.finer.residual import ResidualTracks
from lerobot_msdyn.motion.from_tracks.clusters import direction_features, filled, k_means
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.model.binding import nearest_bases
from lerobot_msdyn.motion.spec import Binding, FinerLevel

_FOLLOWED = 5  # primitives that a point may follow, all of its own part
_LEAST = 30  # tracks of a primitive, or ...
_LEAST_SHARE = 0.01  # ... this share of its part's, if that is more
_LEAST_OF_FEW = 6  # where a part has few


@MOTION_LEVELS.register("primitive")
class Primitives(FinerLevel):
    """Tracks of a part, clustered by the direction of their motion and their place."""

    after = ("object",)
    frames_per_knot = 2

    def cluster(self, tracks: ResidualTracks, config: MotionConfig, noise: float) -> Int[Tensor, " n"]:
        """By k-means."""
        count, most = len(tracks.points), config.primitives
        least = int(max(_LEAST_OF_FEW, min(count / (2 * most), max(_LEAST, _LEAST_SHARE * count))))
        positions = filled(tracks.positions, tracks.weights > 0)
        return k_means(direction_features(tracks.points, positions, noise), most, least)

    def bind(
        self, level: MotionLevel, points: Float[Tensor, "n 3"], part: Int[Tensor, " n"], coarser: Binding | None
    ) -> Binding:
        """The nearest of its part."""
        return nearest_bases(level, points, part[:, None], _FOLLOWED)
