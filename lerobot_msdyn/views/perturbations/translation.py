"""The camera shifted, not turned."""

from dataclasses import dataclass
from typing import ClassVar

from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.perturbation import Perturbation, Viewpoint


@Perturbation.register_subclass("translation")
@dataclass
class Translation(Perturbation):
    """Shift the camera without turning it."""

    moves_rig: ClassVar[bool] = True

    # Largest shift along each of the camera's axes in metres, where the scale is metric.
    translation_m: float = between(0.04, 0, 10)
    # The same as a fraction of the distance to the look-at point, where it is not.
    translation_rel: float = between(0.06, 0, 0.9)

    def bounds(self, view: Viewpoint) -> dict[str, int | float]:
        """A shift along all axes."""
        return view.shifts(self.translation_m, self.translation_rel)
