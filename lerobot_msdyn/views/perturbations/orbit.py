"""The camera turned about the point it looks at, and shifted."""

from dataclasses import dataclass
from typing import ClassVar

from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.perturbation import Perturbation, Viewpoint

METRIC_AZIMUTH_DEG = 15.0  # within which policies gain most by a robot's joints (docs/results.md)


@Perturbation.register_subclass("orbit")
@dataclass
class Orbit(Perturbation):
    """Turn the camera about the point it looks at, and shift it; what is upright stays upright."""

    moves_rig: ClassVar[bool] = True

    # Largest turn to either side, about the vertical, in degrees; null: 15 where the scale is metric, ...
    azimuth_deg: float | None = between(None, 0, 90)
    # ... and this where it is not.
    azimuth_guessed_deg: float = between(10.0, 0, 90)
    # Largest turn up or down, about the horizontal, in degrees.
    elevation_deg: float = between(5.0, 0, 60)
    # Largest shift along each of the camera's axes in metres, where the scale is metric.
    translation_m: float = between(0.05, 0, 10)
    # The same as a fraction of the distance to the look-at point, where it is not.
    translation_rel: float = between(0.03, 0, 0.9)

    def bounds(self, view: Viewpoint) -> dict[str, int | float]:
        """Both angles, and a shift along all axes."""
        azimuth = self.azimuth_deg
        if azimuth is None:
            azimuth = METRIC_AZIMUTH_DEG if view.metric else self.azimuth_guessed_deg
        angles = {"azimuth_deg": azimuth, "elevation_deg": self.elevation_deg}
        return angles | view.shifts(self.translation_m, self.translation_rel)
