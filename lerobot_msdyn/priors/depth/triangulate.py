"""Depth from calibrated cameras that are far apart: matched SIFT features, triangulated, and spread over the image.

Sparse and rough: a few hundred points carry the whole image. Better than a table plane where there is no table; no
match for a depth sensor.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.priors.depth.stereo import relative_pose

type Points = Float32[ndarray, "_ 3"]  # x, y (px) and z-depth (m)

_FEATURES = 3000
_RATIO = 0.8  # of the best match's distance to the second best
_EPIPOLAR_PX = 1.5
_MIN_PARALLAX_DEG = 1.0
_REPROJECTION_PX = 2.0
_MIN_FRAMES = 3  # in which a point of the background is found ...
_SAME_DEPTH = 0.1  # ... at the same depth, up to this share
_OUTLIER = 4.0  # times the median difference to the median
_CELL = 8  # px; points are thinned to their median inverse depth per cell


@dataclass(frozen=True)
class Features:
    """Recognisable points of a picture."""

    xy: Float[ndarray, "n 2"]  # px
    descriptors: Float32[ndarray, "n d"]


def find_features(image: UInt8[ndarray, "h w 3"]) -> Features:
    """SIFT features (Lowe, IJCV 2004) of a picture whose contrast is evened out: cameras differ in exposure."""
    points, descriptors = cv2.SIFT.create(_FEATURES, contrastThreshold=0.02).detectAndCompute(_equalised(image), None)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    return Features(np.array([point.pt for point in points]) + 0.5, descriptors)


def matched_points(features: Features, others: Features, camera: CameraTrack, other: CameraTrack) -> Points:
    """x, y (px) and z-depth (m) in `camera` of features that both pictures show and that fit the calibration."""
    if min(len(features.xy), len(others.xy)) < 2:
        return np.zeros((0, 3), np.float32)
    pairs = np.array(_mutual(features.descriptors, others.descriptors), int).reshape(-1, 2)
    return triangulated(features.xy[pairs[:, 0]], others.xy[pairs[:, 1]], camera, other)


def confirmed(points: list[Points]) -> Points:
    """The points of a fixed background, gathered over the frames, that several frames put at about the same depth.

    Chance matches happen once; what is there is found again at the same place.
    """
    frame = np.repeat(np.arange(len(points)), [len(cloud) for cloud in points])
    gathered = np.concatenate(points)
    cells = np.floor(gathered[:, :2] / _CELL).astype(int)
    kept = np.zeros(len(gathered), bool)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    for index in range(int(cell.max()) + 1 if len(cell) else 0):
        rows = np.nonzero(cell == index)[0]
        z = gathered[rows, 2]
        alike = np.abs(z / np.median(z) - 1) < _SAME_DEPTH
        kept[rows[alike]] = len(np.unique(frame[rows[alike]])) >= _MIN_FRAMES
    return gathered[kept]


def without_outliers(points: Points) -> Points:
    """The points of one thing, without those whose depth is far from the usual one."""
    if len(points) == 0:
        return points
    inverse = 1 / points[:, 2]
    off = np.abs(inverse - np.median(inverse))
    return points[off <= _OUTLIER * max(float(np.median(off)), 0.02 * float(np.median(inverse)))]


def _equalised(image: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "h w"]:
    """Cameras differ in exposure and white balance."""
    return cv2.createCLAHE(3.0, (8, 8)).apply(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def _mutual(a: Float32[ndarray, "n d"], b: Float32[ndarray, "m d"]) -> list[tuple[int, int]]:
    """Pairs that are each other's best match, and clearly so."""
    matcher = cv2.BFMatcher()
    there = [m[0] for m in matcher.knnMatch(a, b, k=2) if m[0].distance < _RATIO * m[1].distance]
    back = {m.queryIdx: m.trainIdx for m in matcher.match(b, a)}
    return [(m.queryIdx, m.trainIdx) for m in there if back[m.trainIdx] == m.queryIdx]


def triangulated(
    a: Float[ndarray, "n 2"], b: Float[ndarray, "n 2"], camera: CameraTrack, other: CameraTrack
) -> Float32[ndarray, "m 3"]:
    """Pairs of pixels as x, y (px) and z-depth (m) in the first camera, without those that do not fit the two's poses.

    Of either camera the first frame counts.
    """
    pose = relative_pose(camera, other)
    k_a, k_b = (c.intrinsics[0].double().numpy() for c in (camera, other))
    project_a, project_b = k_a @ np.eye(3, 4), k_b @ pose[:3]
    x, y, z = pose[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pose[:3, :3]
    fundamental = np.linalg.inv(k_b).T @ essential @ np.linalg.inv(k_a)
    lines = np.c_[a, np.ones(len(a))] @ fundamental.T
    with np.errstate(divide="ignore", invalid="ignore"):  # cameras in one place
        off = np.abs((np.c_[b, np.ones(len(b))] * lines).sum(1)) / np.linalg.norm(lines[:, :2], axis=1)
    a, b = a[off < _EPIPOLAR_PX], b[off < _EPIPOLAR_PX]
    if len(a) == 0:
        return np.zeros((0, 3), np.float32)
    points = cv2.triangulatePoints(project_a, project_b, a.T, b.T)
    with np.errstate(divide="ignore", invalid="ignore"):  # rays that do not meet
        points = (points[:3] / points[3]).T
    there = points @ pose[:3, :3].T + pose[:3, 3]
    centre = -pose[:3, :3].T @ pose[:3, 3]
    towards = points - centre
    cosine = (points * towards).sum(1) / np.linalg.norm(points, axis=1) / np.linalg.norm(towards, axis=1)
    seen_a, seen_b = points @ k_a.T, there @ k_b.T
    error = np.maximum(
        np.linalg.norm(seen_a[:, :2] / seen_a[:, 2:] - a, axis=1),
        np.linalg.norm(seen_b[:, :2] / seen_b[:, 2:] - b, axis=1),
    )
    good = (points[:, 2] > 0) & (there[:, 2] > 0) & (error < _REPROJECTION_PX)
    good &= cosine < np.cos(np.radians(_MIN_PARALLAX_DEG))
    return np.c_[a, points[:, 2]][good].astype(np.float32)


def spread(points: Float32[ndarray, "n 3"], inside: Bool[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Sparse points (x, y px, z m) as a dense z-depth of the pixels `inside`, 0 elsewhere (and if there are no points).

    Points are thinned to the median of their cell; inverse depth is interpolated by normalised convolution with
    Gaussians that widen where there are no points nearby.
    """
    height, width = inside.shape
    column, row = points[:, 0].astype(int), points[:, 1].astype(int)
    within = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    points, column, row = points[within], column[within], row[within]
    points = points[inside[row, column]]
    if len(points) == 0:
        return np.zeros((height, width), np.float32)
    value, weight = _thinned(points, height, width)
    total, reach = np.zeros_like(value), np.zeros_like(value)
    sigma = 1.0
    while sigma < max(value.shape):  # the narrowest Gaussian with points in it decides
        near = cv2.GaussianBlur(weight, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        emphasis = np.float32(sigma**-4)
        total += emphasis * cv2.GaussianBlur(value * weight, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        reach += emphasis * near
        sigma *= 2
    dense = np.where(reach > 0, total / np.maximum(reach, 1e-30), np.median(1 / points[:, 2]))
    inverse = cv2.resize(dense.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    low, high = 1 / points[:, 2].max(), 1 / points[:, 2].min()
    return np.where(inside, 1 / inverse.clip(low, high), 0).astype(np.float32)


def _thinned(
    points: Float32[ndarray, "n 3"], height: int, width: int
) -> tuple[Float32[ndarray, "a b"], Float32[ndarray, "a b"]]:
    """Per cell: the median inverse depth of its points, and 1 where there are any."""
    shape = -(-height // _CELL), -(-width // _CELL)
    value, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    cell = (points[:, 1] // _CELL).astype(int) * shape[1] + (points[:, 0] // _CELL).astype(int)
    for index in np.unique(cell):
        value.flat[index] = np.median(1 / points[cell == index, 2])
        weight.flat[index] = 1
    return value, weight
