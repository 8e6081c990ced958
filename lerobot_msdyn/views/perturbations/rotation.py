"""The camera turned in place."""

from dataclasses import dataclass

from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.perturbation import Perturbation, Viewpoint


@Perturbation.register_subclass("rotation")
@dataclass
class Rotation(Perturbation):
    """Turn the camera in place."""

    # Largest turn to either side, in degrees.
    pan_deg: float = between(3.0, 0, 45)
    # Largest turn up or down, in degrees.
    tilt_deg: float = between(3.0, 0, 45)
    # Largest turn about the optical axis, in degrees.
    roll_deg: float = between(3.0, 0, 45)

    def bounds(self, view: Viewpoint) -> dict[str, int | float]:
        """The turns about the camera's axes."""
        return {"turn_x_deg": self.tilt_deg, "turn_y_deg": self.pan_deg, "turn_z_deg": self.roll_deg}
