"""A longer or shorter focal length: the pose stays."""

import math
from dataclasses import dataclass

from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.perturbation import Perturbation, Viewpoint


@Perturbation.register_subclass("focal")
@dataclass
class Focal(Perturbation):
    """Change the focal length."""

    # Largest change: 0.1 makes it up to 1.1 times as long or as short.
    zoom: float = between(0.1, 0, 1)

    def bounds(self, view: Viewpoint) -> dict[str, int | float]:
        """The logarithm, so that longer and shorter are alike."""
        return {"log_zoom": math.log1p(self.zoom)}
