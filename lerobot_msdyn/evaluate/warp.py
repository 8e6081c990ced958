"""A picture seen from elsewhere by its depth alone: what a user would try first."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import project, transform_points, unproject_image

INPAINT_RADIUS_PX = 3
SAME_SURFACE = 0.015  # relative difference of depth within which two points are of one surface
MIN_WEIGHT = 0.05  # of a pixel, below which a point does not touch it


def warped(
    rgb: UInt8[ndarray, "h w 3"], depth: Float[ndarray, "h w"], camera: CameraTrack, target: CameraTrack
) -> UInt8[ndarray, "H W 3"]:
    """A picture with depth (m, 0 = unknown) through another camera (tracks of one pose each); holes are inpainted.

    Every pixel is spread over the four around its new place, in bilinear weights; what lies behind is left out.
    """
    points = unproject_image(torch.from_numpy(depth), camera.intrinsics[0]).reshape(-1, 3)
    points = transform_points(target.camera_from_world[0] @ camera.world_from_camera[0], points)
    xy, z = (values.numpy() for values in project(points, target.intrinsics[0]))
    place, weight, pixel = _spread(xy - 0.5, (depth.reshape(-1) > 0) & (z > 0), target.width, target.height)
    nearest = np.full(target.height * target.width, np.inf)
    np.minimum.at(nearest, place, z[pixel])
    front = z[pixel] < (1 + SAME_SURFACE) * nearest[place]
    place, weight, pixel = place[front], weight[front], pixel[front]
    total = np.bincount(place, weight, len(nearest))
    colours = rgb.reshape(-1, 3)[pixel] * weight[:, None]
    picture = np.stack([np.bincount(place, colours[:, c], len(nearest)) for c in range(3)], axis=-1)
    picture = (picture / np.maximum(total, 1e-9)[:, None]).round().astype(np.uint8)
    picture, hole = picture.reshape(target.height, target.width, 3), (total == 0).reshape(target.height, target.width)
    return cv2.inpaint(picture, hole.astype(np.uint8), INPAINT_RADIUS_PX, cv2.INPAINT_TELEA) if hole.any() else picture


def _spread(
    at: Float[ndarray, "n 2"], usable: Bool[ndarray, " n"], width: int, height: int
) -> tuple[Int[ndarray, " m"], Float[ndarray, " m"], Int[ndarray, " m"]]:
    """Flat index of the pixels that points (px, pixel centres at whole numbers) fall on, the weight, and the point."""
    corner = np.floor(at).astype(np.int64)
    places, weights, points = [], [], []
    for offset in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = (corner + offset).T
        weight = (1 - np.abs(at - (corner + offset))).prod(1)
        inside = usable & (weight > MIN_WEIGHT) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        places.append((y * width + x)[inside])
        weights.append(weight[inside])
        points.append(np.flatnonzero(inside))
    return np.concatenate(places), np.concatenate(weights), np.concatenate(points)
