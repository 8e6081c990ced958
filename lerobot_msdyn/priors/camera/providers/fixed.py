"""A camera that stands still."""

import logging

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import FIXED
from lerobot_msdyn.core.fields import AUTO
from lerobot_msdyn.core.sampling import scaled_px
from lerobot_msdyn.priors.camera.steadiness import FIXED_PX, SWAY_PX, camera_motion_px
from lerobot_msdyn.priors.registry import CAMERAS, CameraProvider, Estimate, Masks
from lerobot_msdyn.priors.request import Request

logger = logging.getLogger(__name__)


@CAMERAS.register(FIXED)
class Fixed(CameraProvider):
    """The camera as a pose column or the calibration has it, else as it is assumed; can always be used."""

    rank = 10

    def estimate(self, request: Request, instances: Masks) -> Estimate[CameraTrack]:
        """A camera that moves although nobody stated that it is fixed is named in a warning."""
        camera = request.view.camera
        motion = camera_motion_px(request.view.rgb, instances > 0) / scaled_px(1, request.view.camera.width)
        if motion > SWAY_PX and camera.is_static and request.camera.poses == AUTO:
            logger.warning(
                "camera: the picture of %s moves by %.1f px between frames that are a twentieth of the clip apart, "
                "yet it is taken as fixed (--camera.poses sfm or FILE.npz gives it a pose per frame)",
                request.key or "the camera",
                motion,
            )
        return Estimate(camera, _verdict(motion), provider="" if camera.origin == "assumed" else camera.origin)


def _verdict(motion_px: float) -> str:
    if motion_px < FIXED_PX:
        return f"the picture keeps still ({motion_px:.2f} px)"
    return f"the picture {'sways' if motion_px <= SWAY_PX else 'moves'} by {motion_px:.1f} px"
