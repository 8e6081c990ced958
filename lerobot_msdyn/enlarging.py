"""Scenes that are drawn larger than they were fitted."""

import math
from dataclasses import replace

import torch

from lerobot_msdyn.cameras import CameraTrack
from lerobot_msdyn.geometry import transform_points
from lerobot_msdyn.render.types import COVARIANCE_BLUR
from lerobot_msdyn.scene import DynamicScene, Gaussians


def enlarged(scene: DynamicScene, camera: CameraTrack, ratio: float) -> DynamicScene:
    """The scene with Gaussians that cover in larger pictures what they covered in those of the fit.

    The rasterizer widens every Gaussian by a low-pass filter of constant size in pixels, and the fit makes up for it by
    smaller ones: in a larger picture, where pixels are finer, there are gaps between them. What the filter lacks there
    is added to the Gaussians themselves (as the 3D filter of Mip-Splatting, Yu et al. 2024, for another end).

    Args:
        scene: fitted; its overlay stays as it is (`unexplained` makes it for larger pictures where they are wanted).
        camera: through which it was fitted, at that size. The moving set is taken to be as far off at all times as its
            canonical positions are from the first pose.
        ratio: width of the larger pictures to that of the fitted ones; up to 1 nothing is changed.
    """
    if ratio <= 1:
        return scene
    variance_px = COVARIANCE_BLUR * (1 - ratio**-2)
    static, moving = (_widened(part, camera, variance_px) for part in (scene.static, scene.moving))
    return replace(scene, static=static, moving=moving)


def _widened(gaussians: Gaussians, camera: CameraTrack, variance_px: float) -> Gaussians:
    """The same with a variance (px²) added along all axes; what is behind the camera stays as it is."""
    pose, focal_px = camera.camera_from_world[0].to(gaussians.means), float(camera.intrinsics[0].diagonal()[:2].mean())
    depth = transform_points(pose, gaussians.means)[:, 2:].clamp(min=0)  # m
    added = math.sqrt(variance_px) / focal_px * depth
    return replace(gaussians, log_scales=torch.logaddexp(2 * gaussians.log_scales, 2 * added.log()) / 2)
