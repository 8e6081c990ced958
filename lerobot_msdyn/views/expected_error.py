"""The error to be expected of a new view of a scene, without ground truth.

A new view is wrong by what the scene gets wrong in its own video, and by what only shows once the camera moves: where
depth is wrong, a point is rendered some pixels from its place. How much that costs is read off the recorded picture: it
is compared with itself, shifted by as many pixels. Errors are mean squares of colours 0..1 and add up.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import pixel_grid, project, transform_points, unproject
from lerobot_msdyn.reconstruction.account import decibels
from lerobot_msdyn.reconstruction.self_check import SelfCheck

FINEST_PX = 12**-0.5  # along each axis, by which a point is off that lies anywhere within a pixel: (1/12)^(1/2)
BETWEEN = 0.5  # where two depths disagree, the truth is taken to lie in the middle


@dataclass(frozen=True)
class Expected:
    """Expected mean square errors of some frames of a new view, by cause; they add up."""

    video: Float[Tensor, " t"]  # as in the recorded view
    geometry: Float[Tensor, " t"]  # the scene's depth is not the prior's
    depth: Float[Tensor, " t"]  # the prior's depth is not the truth, as far as its provider is known to err
    sampling: Float[Tensor, " t"]  # a point may lie anywhere within its pixel

    @property
    def total(self) -> Float[Tensor, " t"]:
        """Mean square error of each frame."""
        return self.video + self.geometry + self.depth + self.sampling

    @property
    def psnr_db(self) -> float:
        """Expected peak signal-to-noise ratio over all frames."""
        return decibels(float(self.total.mean()))

    @property
    def shares(self) -> dict[str, float]:
        """Share of the error of each cause, 0..1."""
        return {name: float(value.mean() / self.total.mean()) for name, value in vars(self).items()}


@torch.no_grad()
def expected_error(check: SelfCheck, new: CameraTrack) -> Expected:
    """What is to be expected of a new camera, one pose per frame of the checked frames.

    Args:
        check: how well the scene explains its own video.
        new: the new camera at those frames, at any size.
    """
    camera, measured = check.camera, check.depth > 0
    new = new.resized(camera.width, camera.height)
    prior = torch.where(measured, check.depth, check.rendered_depth)
    place = _seen_from(camera, new, prior)
    rendered = (_seen_from(camera, new, check.rendered_depth) - place) * BETWEEN
    unsure = _seen_from(camera, new, prior * (1 + check.depth_error)) - place
    within = torch.full_like(rendered, FINEST_PX)
    return Expected(
        check.error,
        _misplaced(check.recorded, rendered * (measured & (check.rendered_depth > 0))[..., None]),
        _misplaced(check.recorded, unsure * (prior > 0)[..., None]),
        _misplaced(check.recorded, within),
    )


def _seen_from(camera: CameraTrack, new: CameraTrack, depth: Float[Tensor, "t h w"]) -> Float[Tensor, "t h w 2"]:
    """Where the pixels of a camera, with depth (m), are in a new one (px)."""
    frames, height, width = depth.shape
    xy = pixel_grid(height, width).reshape(1, -1, 2).expand(frames, -1, -1)
    points = unproject(xy, depth.reshape(frames, -1), camera.intrinsics)
    in_new = transform_points(new.camera_from_world @ camera.world_from_camera, points)
    return project(in_new, new.intrinsics)[0].reshape(frames, height, width, 2)


def _misplaced(pictures: Float[Tensor, "t h w 3"], by: Float[Tensor, "t h w 2"]) -> Float[Tensor, " t"]:
    """Mean square difference of pictures to themselves, each pixel displaced by so many pixels."""
    height, width = by.shape[1:3]
    size = torch.tensor([width, height])
    reach = 0.25 * size
    to = (pixel_grid(height, width) + torch.nan_to_num(by).clamp(-reach, reach)) / size * 2 - 1
    there = torch.nn.functional.grid_sample(
        pictures.permute(0, 3, 1, 2), to, padding_mode="border", align_corners=False
    )
    return (there.permute(0, 2, 3, 1) - pictures).square().mean((1, 2, 3))
