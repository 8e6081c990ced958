"""The camera turned in place, about the vertical, the horizontal and its optical axis."""

from dataclasses import dataclass

from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.perturbation import Perturbation, Viewpoint


@Perturbation.register_subclass("rotation")
@dataclass
class Rotation(Perturbation):
    """Turn the camera in place; without `roll_deg` what is upright stays upright."""

    # Largest turn to either side, about the vertical, in degrees.
    pan_deg: float = between(3.0, 0, 45)
    # Largest turn up or down, about the horizontal, in degrees.
    tilt_deg: float = between(3.0, 0, 45)
    # Largest turn about the optical axis, in degrees.
    roll_deg: float = between(3.0, 0, 45)

    def bounds(self, view: Viewpoint) -> dict[str, int | float]:
        """The three turns."""
        return {"pan_deg": self.pan_deg, "tilt_deg": self.tilt_deg, "turn_z_deg": self.roll_deg}
