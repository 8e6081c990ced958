"""Which Gaussians some pixels of a picture show, without rendering it."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.visibility import projected
from lerobot_msdyn.render.types import COVARIANCE_BLUR, MIN_ALPHA

SIGMAS = math.sqrt(-2 * math.log(MIN_ALPHA))  # standard deviations to where an opaque Gaussian is no longer shown
MOST_STRETCH = 3.0  # by which one beside the optical axis, where perspective is still linear, is longer than on it
SLACK_PX = 1.0  # by which distances between pixels may be off


@dataclass(frozen=True)
class Footprints:
    """About where a camera sees Gaussians."""

    pixel: Int[Tensor, " n"]  # of the centre, row by row; of the nearest one where the centre is outside
    reach: Float[Tensor, " n"]  # px, from there, within which all that it may cover lies; below 0: it is not seen

    def may_cover(self, where: Bool[ndarray, "h w"]) -> Bool[Tensor, " n"]:
        """Which may cover any of some pixels: all that do, and some that do not."""
        distance = cv2.distanceTransform((~where).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)
        return torch.from_numpy(distance).to(self.pixel.device).flatten()[self.pixel] <= self.reach


def footprints(means: Float[Tensor, "n 3"], sizes: Float[Tensor, " n"], camera: CameraTrack) -> Footprints:
    """Those of Gaussians at some places (m, world) through the first pose of a camera.

    `sizes` (m) are their largest standard deviations.
    """
    seen = projected(means, camera)
    row, column = seen.pixel
    focal, centre = camera.intrinsics[0, 0, 0], camera.intrinsics[0, :2, 2]
    stretch = (1 + ((seen.xy - centre) / focal).square().sum(-1)).sqrt().clamp(max=MOST_STRETCH)
    deviation_px = stretch * sizes * focal / seen.z.clamp(min=1e-6)
    reach = SLACK_PX + SIGMAS * (deviation_px.square() + COVARIANCE_BLUR).sqrt()
    return Footprints(row * camera.width + column, reach.masked_fill(seen.z <= 0, -1.0))
