"""Where the camera stands and what its lens is, as far as the video, a file or the user can tell."""

import logging
from dataclasses import replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.geometry import invert_se3
from lerobot_msdyn.core.observations import DepthTraits, Origin, PointTracks
from lerobot_msdyn.priors.camera.field_of_view import fov_from_rigid_motion
from lerobot_msdyn.priors.camera.sfm import camera_from_sfm
from lerobot_msdyn.priors.camera.steadiness import FIXED_PX, SWAY_PX, camera_motion_px
from lerobot_msdyn.priors.masks.provide import file_origin
from lerobot_msdyn.priors.request import FILE, Request

logger = logging.getLogger(__name__)


def provide_camera(request: Request, instances: UInt8[Tensor, "t h w"]) -> tuple[Request, Origin]:
    """The request with the camera that `camera.poses` names; `instances` are the masks.

    Raises:
        PriorError: it was asked for by name and cannot be had.
    """
    provider = request.camera.poses
    camera = request.view.camera
    if provider.endswith(FILE):
        camera, origin = _from_file(request, provider)
    elif provider == "sfm":
        camera = camera_from_sfm(request.view, instances)
        origin = Origin("sfm", "asked for; its unit of length is not the metre")
    else:
        motion = camera_motion_px(request.view.rgb, instances > 0)
        origin = Origin(camera.origin if camera.origin != "assumed" else "fixed", _verdict(motion))
        if motion > SWAY_PX and camera.is_static and provider == "auto":
            logger.warning(
                "camera: the picture of %s moves by %.1f px between frames that are a twentieth of the clip apart, "
                "yet it is taken as fixed (--camera.poses sfm or FILE.npz gives it a pose per frame)",
                request.key or "the camera",
                motion,
            )
    return replace(request, view=replace(request.view, camera=camera)), origin


def _verdict(motion_px: float) -> str:
    if motion_px < FIXED_PX:
        return f"the picture keeps still ({motion_px:.2f} px)"
    return f"the picture {'sways' if motion_px <= SWAY_PX else 'moves'} by {motion_px:.1f} px"


def _from_file(request: Request, pattern: str) -> tuple[CameraTrack, Origin]:
    content = request.exchange(pattern)
    if content.K is None and content.w2c is None:
        raise PriorError(f"camera.poses: {pattern} has neither K nor w2c; see docs/priors.md")
    camera = replace(request.view.camera, origin="exchange")
    if content.K is not None:
        camera = replace(camera, intrinsics=torch.from_numpy(content.K).contiguous())
    if content.w2c is not None:
        pose = invert_se3(torch.from_numpy(content.w2c).double()).float()
        camera = replace(camera, world_from_camera=pose)
    return camera, file_origin(content.provenance.get("camera"), pattern)


def with_searched_fov(
    camera: CameraTrack, tracks: PointTracks, depth: Float[Tensor, "t h w"], traits: DepthTraits
) -> tuple[CameraTrack, Origin]:
    """The camera with the field of view at which rigid things keep their size.

    Raises:
        PriorError: the depth is that of an assumed plane, or nothing turns enough to tell.
    """
    if traits.assumed:
        raise PriorError(
            "camera.fov_search needs depth that does not depend on the field of view: recorded, learned or from a file"
        )
    fov, correlation = fov_from_rigid_motion(tracks, depth.numpy(), camera)
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = intrinsics_from_fov(camera.width, camera.height, fov)[0, 0]
    why = f"rigid things keep their size at {fov:.1f} degrees (correlation {correlation:.2f})"
    return replace(camera, intrinsics=intrinsics, origin="fov_search"), Origin("fov_search", why)
