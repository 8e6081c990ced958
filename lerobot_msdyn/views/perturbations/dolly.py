"""The camera moved along its optical axis."""

from dataclasses import dataclass

from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.perturbation import Perturbation, Viewpoint


@Perturbation.register_subclass("dolly")
@dataclass
class Dolly(Perturbation):
    """Move the camera along its optical axis."""

    # Largest way forth or back in metres, where the scale is metric.
    translation_m: float = between(0.06, 0, 10)
    # The same as a fraction of the distance to the look-at point, where it is not.
    translation_rel: float = between(0.1, 0, 0.9)

    def bounds(self, view: Viewpoint) -> dict[str, int | float]:
        """A shift along one axis."""
        return view.shifts(self.translation_m, self.translation_rel, "z")
