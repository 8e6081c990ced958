"""Frames of a camera that drifts, as one that stands in its usual place would have recorded them."""

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Float64, Shaped
from numpy import ndarray

from lerobot_msdyn.core.images import masked_median
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.priors.camera.path import CameraPath, distances_px

NEGLIGIBLE_PX = 0.25  # of 320: frames that are so near to the usual place stay as they are
SAMPLES = 60  # frames that show what is beyond the edges of others


def steadied(view: View, path: CameraPath) -> View:
    """The video laid over its camera's usual place; what a frame does not show there is the median of those that do.

    Args:
        view: the video, at any size.
        path: from the usual place to where the camera is at each of its frames.
    """
    height, width = view.rgb.shape[1:3]
    affines = path.resized(width, height).affines
    away = distances_px(path) > NEGLIGIBLE_PX
    rgb, seen = view.rgb.numpy().copy(), np.ones(view.rgb.shape[:3], bool)
    depth = None if view.depth is None else view.depth.numpy().copy()
    for frame in np.flatnonzero(away):
        rgb[frame] = _laid_over(rgb[frame], affines[frame], cv2.INTER_CUBIC)
        seen[frame] = _laid_over(np.ones((height, width), np.uint8), affines[frame], cv2.INTER_NEAREST) > 0
        if depth is not None:
            depth[frame] = _laid_over(depth[frame], affines[frame], cv2.INTER_NEAREST)
    some = np.append(evenly(len(rgb), SAMPLES).numpy(), np.flatnonzero(~away)[:1])
    beyond = ~seen.all(0)
    usual = masked_median(rgb[some][:, beyond], seen[some][:, beyond, None]).round().astype(np.uint8)
    for frame in np.flatnonzero(away):
        rgb[frame][beyond] = np.where(seen[frame][beyond, None], rgb[frame][beyond], usual)
    return replace(view, rgb=torch.from_numpy(rgb), depth=None if depth is None else torch.from_numpy(depth))


def _laid_over(
    image: Shaped[ndarray, "h w *c"], affine: Float64[ndarray, "2 3"], interpolation: int
) -> Shaped[ndarray, "h w *c"]:
    """An image at the usual place; where it does not show it 0, or with cubic interpolation the colour of its edge."""
    size = (image.shape[1], image.shape[0])
    border = cv2.BORDER_REPLICATE if interpolation == cv2.INTER_CUBIC else cv2.BORDER_CONSTANT
    return cv2.warpAffine(image, affine, size, flags=interpolation | cv2.WARP_INVERSE_MAP, borderMode=border)
