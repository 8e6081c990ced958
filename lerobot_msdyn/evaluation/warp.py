"""A picture seen from elsewhere by its depth alone: what a user would try first."""

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray

from lerobot_msdyn.cameras import CameraTrack
from lerobot_msdyn.geometry import project, transform_points, unproject_image

INPAINT_RADIUS_PX = 3


def warped(
    rgb: UInt8[ndarray, "h w 3"], depth: Float[ndarray, "h w"], camera: CameraTrack, target: CameraTrack
) -> UInt8[ndarray, "H W 3"]:
    """A picture with depth (m, 0 = unknown) through another camera (tracks of one pose each); holes are inpainted.

    Every pixel goes to the four around its new place, the nearest on top.
    """
    points = unproject_image(torch.from_numpy(depth), camera.intrinsics[0]).reshape(-1, 3)
    points = transform_points(target.camera_from_world[0] @ camera.world_from_camera[0], points)
    xy, z = (values.numpy() for values in project(points, target.intrinsics[0]))
    order = np.argsort(-z, kind="stable")
    order = order[(depth.reshape(-1)[order] > 0) & (z[order] > 0)]
    corner = np.floor(xy[order] - 0.5).astype(np.int64)
    picture = np.zeros((target.height, target.width, 3), np.uint8)
    hole = np.ones((target.height, target.width), np.uint8)
    for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
        x, y = corner[:, 0] + dx, corner[:, 1] + dy
        inside = (x >= 0) & (x < target.width) & (y >= 0) & (y < target.height)
        picture[y[inside], x[inside]] = rgb.reshape(-1, 3)[order[inside]]
        hole[y[inside], x[inside]] = 0
    return cv2.inpaint(picture, hole, INPAINT_RADIUS_PX, cv2.INPAINT_TELEA) if hole.any() else picture
