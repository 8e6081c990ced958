"""The camera where another one of the rig stands."""

from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float32
from numpy import ndarray

from lerobot_msdyn.core.perturbation import Perturbation, Viewpoint


@Perturbation.register_subclass("other_camera")
@dataclass
class OtherCamera(Perturbation):
    """Look from where another calibrated camera stands."""

    allows_per_frame: ClassVar[bool] = False

    # Its name in the calibration file.
    camera: str = ""

    @property
    def needs_pose_of(self) -> str:
        """The camera that is looked from."""
        return self.camera

    def problems(self) -> list[str]:
        """What is wrong between fields."""
        unnamed = [] if self.camera else ["camera is empty; expected the name of a camera in the calibration file"]
        return unnamed + super().problems()

    def amounts(self, shares: Float32[ndarray, "s n"], view: Viewpoint, variant: int) -> Float32[ndarray, "s n"]:
        """Those that bring the recorded camera to the other's pose."""
        from lerobot_msdyn.core.geometry import invert_se3
        from lerobot_msdyn.views.offsets import amounts_of_pose

        assert view.other is not None
        return amounts_of_pose(invert_se3(view.camera.world_from_camera[0]) @ view.other)
