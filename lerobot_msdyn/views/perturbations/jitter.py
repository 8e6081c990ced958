"""The camera shifted and turned in place by normally distributed amounts."""

from dataclasses import dataclass

from jaxtyping import Float32
from numpy import ndarray

from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.perturbation import Perturbation, Viewpoint

LARGEST = 3.0  # standard deviations


@Perturbation.register_subclass("jitter")
@dataclass
class Jitter(Perturbation):
    """Shift and turn the camera in place, as if it had been bumped."""

    # Standard deviation of the shift along each of the camera's axes in metres, where the scale is metric.
    translation_m: float = between(0.012, 0, 10)
    # The same as a fraction of the look-at distance, where it is not.
    translation_rel: float = between(0.02, 0, 0.9)
    # Standard deviation of the turn about each of the camera's axes, in degrees.
    rotation_deg: float = between(1.0, 0, 45)

    def bounds(self, view: Viewpoint) -> dict[str, int | float]:
        """Standard deviations of the shift and the turn."""
        turns = {f"turn_{axis}_deg": self.rotation_deg for axis in "xyz"}
        return turns | view.shifts(self.translation_m, self.translation_rel)

    def shares(
        self, uniform: Float32[ndarray, "t n"], phases: Float32[ndarray, "t n"], frames: int
    ) -> Float32[ndarray, "s n"]:
        """Normally distributed, in standard deviations."""
        import torch

        normal: ndarray = torch.special.ndtri(torch.from_numpy(uniform).double()).float().numpy()
        return normal.clip(-LARGEST, LARGEST)
