"""Depth from two calibrated cameras that are close together: rectified, then semi-global matching (OpenCV's SGBM)."""

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import invert_se3

_BLOCK = 5  # px
_MAX_DISPARITY_SHARE = 0.4  # of the image's width
_CHANNELS = 3


class RectifiedPair:
    """Two fixed cameras whose images are turned so that a point lies in the same row of both."""

    def __init__(self, camera: CameraTrack, other: CameraTrack) -> None:
        """`camera` is the one whose depth is wanted."""
        pose = relative_pose(camera, other)
        self._k = camera.intrinsics[0].double().numpy()
        k_other = other.intrinsics[0].double().numpy()
        self._size, self._other_size = (camera.width, camera.height), (other.width, other.height)
        nothing = np.zeros(5)
        self._turn, turn_other, self._p, p_other, *_ = cv2.stereoRectify(
            self._k,
            nothing,
            k_other,
            nothing,
            self._size,
            pose[:3, :3],
            pose[:3, 3],
            flags=cv2.CALIB_ZERO_DISPARITY,
            alpha=-1,
        )
        self._upright = abs(p_other[0, 3]) >= abs(p_other[1, 3])  # else the cameras stand above each other
        shift = p_other[0, 3] if self._upright else p_other[1, 3]
        self._mirrored = shift > 0  # the other camera is to the left (above): mirror both
        self._focal_baseline = abs(float(shift))  # px m
        self._maps = cv2.initUndistortRectifyMap(self._k, nothing, self._turn, self._p, self._size, cv2.CV_32FC1)
        self._maps_other = cv2.initUndistortRectifyMap(k_other, nothing, turn_other, p_other, self._size, cv2.CV_32FC1)
        length = self._size[0] if self._upright else self._size[1]
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=max(16, int(length * _MAX_DISPARITY_SHARE) // 16 * 16),
            blockSize=_BLOCK,
            P1=8 * _CHANNELS * _BLOCK**2,
            P2=32 * _CHANNELS * _BLOCK**2,
            disp12MaxDiff=1,
            preFilterCap=31,
            uniquenessRatio=10,
            speckleWindowSize=100,
            speckleRange=2,
            mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
        )

    def depth(self, image: UInt8[ndarray, "h w 3"], other: UInt8[ndarray, "h2 w2 3"]) -> Float32[ndarray, "h w"]:
        """z-depth (m) of the first camera's pixels; 0 where the two pictures do not agree on one."""
        pair = [
            self._arranged(cv2.remap(picture, *maps, cv2.INTER_LINEAR))
            for picture, maps in ((image, self._maps), (other, self._maps_other))
        ]
        raw = self._matcher.compute(*pair).astype(np.float32) / 16
        disparity = self._restored(np.where(raw > 0, raw, np.float32(0)))
        z_turned = np.where(disparity > 0, self._focal_baseline / np.maximum(disparity, 1e-6), 0).astype(np.float32)
        return self._seen_by_camera(z_turned)

    def _arranged(self, image: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "a b 3"]:
        """As SGBM wants it: the other camera to the right."""
        turned = image if self._upright else image.transpose(1, 0, 2)
        return np.ascontiguousarray(turned[:, ::-1] if self._mirrored else turned)

    def _restored(self, image: Float32[ndarray, "a b"]) -> Float32[ndarray, "h w"]:
        turned = image[:, ::-1] if self._mirrored else image
        return np.ascontiguousarray(turned if self._upright else turned.T)

    def _seen_by_camera(self, z_turned: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
        """Depth along the turned camera's axis -> that along the camera's own, at its own pixels."""
        width, height = self._size
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = np.stack((x, y, np.ones_like(x)), axis=-1) @ np.linalg.inv(self._k).T @ self._turn.T  # turned, z free
        place = rays @ self._p[:, :3].T
        column, row = (place[..., i] / place[..., 2] - 0.5 for i in (0, 1))
        z = cv2.remap(z_turned, column.astype(np.float32), row.astype(np.float32), cv2.INTER_NEAREST)
        return (z / rays[..., 2]).astype(np.float32)  # a ray of depth 1 in the camera has this depth in the turned one


def relative_pose(camera: CameraTrack, other: CameraTrack) -> Float[ndarray, "4 4"]:
    """other_from_camera of two fixed cameras, m."""
    pose = invert_se3(other.world_from_camera[0].double()) @ camera.world_from_camera[0].double()
    return np.asarray(pose)
