"""The camera moved smoothly along the episode."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.perturbation import Perturbation, Viewpoint


@Perturbation.register_subclass("drift")
@dataclass
class Drift(Perturbation):
    """Move the camera smoothly along the episode, about the point it looks at."""

    moves_rig: ClassVar[bool] = True
    allows_per_frame: ClassVar[bool] = False

    # Largest turn to either side, about the vertical, in degrees.
    azimuth_deg: float = between(6.0, 0, 90)
    # Largest turn up or down, about the horizontal, in degrees.
    elevation_deg: float = between(3.0, 0, 60)
    # Largest shift along each of the camera's axes in metres, where the scale is metric.
    translation_m: float = between(0.02, 0, 10)
    # The same as a fraction of the distance to the look-at point, where it is not.
    translation_rel: float = between(0.03, 0, 0.9)
    # How often it goes back and forth in an episode.
    cycles: float = between(0.5, 0, 100)

    def bounds(self, view: Viewpoint) -> dict[str, int | float]:
        """Both angles, and a shift along all axes."""
        angles = {"azimuth_deg": self.azimuth_deg, "elevation_deg": self.elevation_deg}
        return angles | view.shifts(self.translation_m, self.translation_rel)

    def shares(
        self, uniform: Float32[ndarray, "t n"], phases: Float32[ndarray, "t n"], frames: int
    ) -> Float32[ndarray, "s n"]:
        """Each amount swings as a sine, with an amplitude and a phase that are sampled."""
        time = np.linspace(0, self.cycles, frames, dtype=np.float32)[:, None]
        return (2 * uniform - 1) * np.sin(np.float32(2 * np.pi) * (time + phases))
