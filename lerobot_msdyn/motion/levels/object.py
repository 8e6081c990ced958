"""Objects: one rigid motion per part of an instance."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.registries import MOTION_LEVELS
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.spec import Binding, FirstLevel, PartTracks


@MOTION_LEVELS.register("object")
class Objects(FirstLevel):
    """The motions of the rigid parts; a point follows that of its own."""

    rigid = True
    by_video = True

    def estimate(self, tracks: PartTracks, config: MotionConfig) -> MotionLevel:
        """They are known already."""
        return tracks.objects

    def bind(
        self, level: MotionLevel, points: Float[Tensor, "n 3"], part: Int[Tensor, " n"], coarser: Binding | None
    ) -> Binding:
        """Its own part."""
        return part[:, None], torch.zeros(len(part), 1)
