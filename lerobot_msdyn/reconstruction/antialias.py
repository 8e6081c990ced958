"""Scenes that are rendered larger than they were fitted."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.render.types import COVARIANCE_BLUR
from lerobot_msdyn.scene.dynamic import DynamicScene


def enlarged(scene: DynamicScene, camera: CameraTrack, ratio: float) -> DynamicScene:
    """The scene with Gaussians that cover in larger pictures what they covered in those of the fit.

    The rasterizer widens every Gaussian by a low-pass filter of constant size in pixels, and the fit makes up for it by
    smaller ones: in a larger picture, where pixels are finer, there are gaps between them. What the filter lacks there
    is added to the Gaussians themselves (as the 3D filter of Mip-Splatting, Yu et al. 2024, for another end).

    Args:
        scene: fitted.
        camera: through which it was fitted, at that size. The moving set is taken to be as far off at all times as its
            canonical positions are from the first pose.
        ratio: width of the larger pictures to that of the fitted ones; up to 1 nothing is changed.
    """
    if ratio <= 1:
        return scene
    added_px = math.sqrt(COVARIANCE_BLUR * (1 - ratio**-2))
    added = added_px / float(camera.intrinsics[0].diagonal()[:2].mean())  # of the depth
    poses = camera.camera_from_world.to(scene.device)
    static, moving = (
        replace(part, log_scales=_widened(part.log_scales, added * _depth(part.means, poses[:1])))
        for part in (scene.static, scene.moving)
    )
    overlay, short = scene.overlay, scene.short_lived
    if short is not None:
        far = torch.zeros(len(short.means), device=scene.device)
        for frame in range(scene.frames):
            patch = scene.short_lived_patch(frame)
            if patch is not None:
                far[short.rows(frame)] = _depth(patch.means, poses[frame : frame + 1])
        wider = _widened(short.log_scales.float(), added * far).to(short.log_scales)
        short = replace(short, log_scales=wider)
    if overlay is not None:
        of_rows = torch.repeat_interleave(torch.arange(len(overlay.first) - 1), overlay.first.diff().cpu())
        depth = _depth(overlay.means, poses.to(overlay.means.device)[of_rows])
        wider = _widened(overlay.log_scales.float(), added * depth).to(overlay.log_scales)
        overlay = replace(overlay, log_scales=wider)
    return replace(scene, static=static, moving=moving, short_lived=short, overlay=overlay)


def _depth(means: Float[Tensor, "n 3"], poses: Float[Tensor, "#n 4 4"]) -> Float[Tensor, " n"]:
    """Distances (m) along the line of sight; 0 behind the camera."""
    return ((means * poses[:, 2, :3]).sum(-1) + poses[:, 2, 3]).clamp(min=0)


def _widened(log_scales: Float[Tensor, "n s"], added: Float[Tensor, " n"]) -> Float[Tensor, "n s"]:
    """Scales after the square of a standard deviation (m) is added to the variance along all axes."""
    return torch.logaddexp(2 * log_scales, 2 * added.log()[:, None]) / 2
