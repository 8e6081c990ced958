"""A camera that moves, by structure from motion."""

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.priors.camera.sfm import SFM, camera_from_sfm
from lerobot_msdyn.priors.registry import CAMERAS, CameraProvider, Estimate, Masks
from lerobot_msdyn.priors.request import Request


@CAMERAS.register(SFM)
class StructureFromMotion(CameraProvider):
    """COLMAP through pycolmap; takes minutes, so `auto` does not try it."""

    needs_whole_videos = True

    def estimate(self, request: Request, instances: Masks) -> Estimate[CameraTrack]:
        """See `camera_from_sfm`."""
        return Estimate(camera_from_sfm(request.view, instances), "structure from motion")
