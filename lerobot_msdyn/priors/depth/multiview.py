"""Depth of one camera's video with the help of other calibrated cameras that see the same moments."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.priors.depth.flying_pixels import without_flying_pixels
from lerobot_msdyn.priors.depth.stereo import RectifiedPair, relative_pose
from lerobot_msdyn.priors.depth.triangulate import (
    Points,
    confirmed,
    find_features,
    matched_points,
    spread,
    without_outliers,
)

_MIN_BASELINE_M = 1e-3
_MAX_ANGLE_DEG = 60.0  # between the axes of two cameras; beyond it hardly any feature is recognised
_STEREO_ANGLE_DEG = 15.0  # up to this, semi-global matching of rectified pictures works ...
_STEREO_FORWARD = 0.5  # ... if no more than this share of the baseline is along the axis
_STEREO_KNOWN = 0.3  # of the pixels must be matched, else features are tried
_MIN_POINTS = 20


def usable_partners(view: View, others: Sequence[View]) -> list[View]:
    """The calibrated, fixed cameras that look from another place at about the same things, the nearest view first."""
    if not _is_calibrated(view.camera):
        return []
    angles = [(_angle_deg(view.camera, other.camera), other) for other in others if _is_calibrated(other.camera)]
    return [
        other
        for angle, other in sorted(angles, key=lambda item: item[0])
        if angle < _MAX_ANGLE_DEG and _baseline(view.camera, other.camera) > _MIN_BASELINE_M
    ]


def why_no_partner(view: View, others: Sequence[View]) -> str:
    """Why `usable_partners` finds none, in words."""
    if not others:
        return "no other camera of the episode is read with this one"
    if not _is_calibrated(view.camera):
        return "this camera is not calibrated"
    calibrated = [other.camera for other in others if _is_calibrated(other.camera)]
    if not calibrated:
        return "no other camera is calibrated"
    apart = [camera for camera in calibrated if _baseline(view.camera, camera) > _MIN_BASELINE_M]
    if not apart:
        return "the other calibrated cameras stand at the same place"
    nearest = min(_angle_deg(view.camera, camera) for camera in apart)
    allowed = f"less than {_MAX_ANGLE_DEG:g} needed"
    return f"the nearest other calibrated camera looks {nearest:.0f} degrees elsewhere ({allowed})"


def _is_calibrated(camera: CameraTrack) -> bool:
    return camera.origin in ("calibration", "column", "exchange") and camera.is_static


def _angle_deg(camera: CameraTrack, other: CameraTrack) -> float:
    return math.degrees(math.acos(np.clip(relative_pose(camera, other)[2, 2], -1, 1)))


def _baseline(camera: CameraTrack, other: CameraTrack) -> float:
    return float(np.linalg.norm(relative_pose(camera, other)[:3, 3]))


def multiview_depth(view: View, partners: Sequence[View], instances: UInt8[Tensor, "t h w"]) -> Float[Tensor, "t h w"]:
    """z-depth (m) of every frame, 0 = unknown.

    With a partner that looks in nearly the same direction from the side: semi-global matching per frame. Otherwise
    features are matched with all partners, triangulated, and spread over the image: those of the background from many
    frames at once, those of each moving instance per frame within its mask.

    Raises:
        PriorError: hardly any feature could be matched.
    """
    nearest = partners[0]
    if _is_stereo_pair(view.camera, nearest.camera):
        pair = RectifiedPair(view.camera, nearest.camera)
        frames = zip(view.rgb.numpy(), nearest.rgb.numpy(), strict=True)
        depth = without_flying_pixels(torch.from_numpy(np.stack([pair.depth(a, b) for a, b in frames])))
        if float((depth > 0).float().mean()) > _STEREO_KNOWN:
            return depth
    points = [_points_at(view, partners, frame) for frame in range(len(view.rgb))]
    return torch.from_numpy(_filled(points, instances.numpy()))


def _is_stereo_pair(camera: CameraTrack, other: CameraTrack) -> bool:
    pose = relative_pose(camera, other)
    forward = abs(pose[2, 3]) / np.linalg.norm(pose[:3, 3])
    return bool(_angle_deg(camera, other) < _STEREO_ANGLE_DEG and forward < _STEREO_FORWARD)


def _points_at(view: View, partners: Sequence[View], frame: int) -> Points:
    features = find_features(view.rgb[frame].numpy())
    matched = [
        matched_points(features, find_features(other.rgb[frame].numpy()), view.camera, other.camera)
        for other in partners
    ]
    return np.concatenate(matched)


def _filled(points: list[Points], instances: UInt8[ndarray, "t h w"]) -> Float32[ndarray, "t h w"]:
    """Points of every frame, spread over the background and over each instance."""
    labels = [instance_of(cloud, instances[frame]) for frame, cloud in enumerate(points)]
    still = confirmed([cloud[label == 0] for cloud, label in zip(points, labels, strict=True)])
    if len(still) < _MIN_POINTS:
        raise PriorError(
            f"stereo: only {len(still)} features of the background were found in other cameras over {len(points)} "
            "frames; is the calibration that of this episode, and do the cameras see the same things?"
        )
    background = spread(still, np.ones(instances.shape[1:], bool))
    depth = np.repeat(background[None], len(points), axis=0)
    for number in range(1, int(instances.max()) + 1):
        clouds = [without_outliers(cloud[label == number]) for cloud, label in zip(points, labels, strict=True)]
        seen = [frame for frame, cloud in enumerate(clouds) if len(cloud)]
        if not seen:
            continue  # it keeps the depth of the background
        middle = np.interp(np.arange(len(points)), seen, [np.median(clouds[frame][:, 2]) for frame in seen])
        for frame, cloud in enumerate(clouds):
            mask = instances[frame] == number
            dense = spread(cloud, mask) if len(cloud) >= _MIN_POINTS else np.float32(middle[frame]) * mask
            depth[frame][mask] = dense[mask]
    return depth


def instance_of(points: Points, instances: UInt8[ndarray, "h w"]) -> UInt8[ndarray, " n"]:
    """Instance under each point (x, y px first)."""
    height, width = instances.shape
    return instances[points[:, 1].astype(int).clip(0, height - 1), points[:, 0].astype(int).clip(0, width - 1)]
