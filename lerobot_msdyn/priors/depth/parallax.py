"""Depth of what stands still before a camera that moves with known poses: corners that go by, triangulated."""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.corners import away_from, corners_followed
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.priors.depth.triangulate import Points, spread, triangulated

_FRAMES = 48  # in which corners are looked for
_APART = (0.15, 0.05)  # of the clip, to either side: where they are looked for again, the surest first
_NEAR = 0.1  # of the clip, to either side: whose corners say how deep a frame is
_NEAREST = 3  # frames with corners, at least
_LEAST = 100  # points, together
_SAME = 0.05  # share of the depth by which what is told by several frames may differ
_BENT_OVER = 1 / 24  # of a picture's width: sigma over which other depth is off alike
_BENT_BY = 0.15  # logarithm of the factor; what is off by more is another surface
_HELD = 3.0  # points; so many that are not off hold other depth as it is
type Frames = UInt8[ndarray, "t h w 3"]
type Instances = UInt8[ndarray, "t h w"]


def parallax_points(camera: CameraTrack, rgb: Frames, instances: Instances) -> dict[int, Points]:
    """x, y (px) and z-depth (m) of corners of what stands still, in some frames.

    What other frames tell of a corner must agree. One on what is said to move needs two of them: masks that were made
    without poses say so of much that stands still.

    Raises:
        PriorError: hardly any are found, or the camera only turns.
    """
    frames = len(rgb)
    looked_at = np.unique(np.linspace(0, frames - 1, min(frames, _FRAMES)).round().astype(int)).tolist()
    apart = [sign * max(1, round(share * frames)) for share in _APART for sign in (-1, 1)]
    grey: dict[int, ndarray] = {}

    def picture(frame: int) -> UInt8[ndarray, "h w"]:
        if frame not in grey:
            grey[frame] = cv2.cvtColor(rgb[frame], cv2.COLOR_RGB2GRAY)
        return grey[frame]

    found: dict[int, Points] = {}
    for frame in looked_at:
        still, told = away_from(instances[frame] > 0) > 0, []
        for other in (frame + gap for gap in apart):
            if 0 <= other < frames:
                here, there = corners_followed(picture(frame), picture(other))
                cameras = camera.select([frame]), camera.select([other])
                told.append(triangulated(here + 0.5, there + 0.5, *cameras))
        found[frame] = _agreed(told, still)
    count = sum(len(points) for points in found.values())
    if count < _LEAST:
        raise PriorError(
            f"the camera's way tells the depth of {count} corners; expected {_LEAST} or more: it goes too little "
            "to the side, its poses are not those of this video, or there is no texture"
        )
    return found


def _agreed(told: Sequence[Points], still: Bool[ndarray, "h w"]) -> Points:
    """Of the corners that a frame has, each once, as the first of the others says that knows it, if all agree."""
    gathered = np.concatenate(told) if told else np.zeros((0, 3), np.float32)
    if len(gathered) == 0:
        return gathered
    _, first, corner, often = np.unique(
        gathered[:, :2], axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    points = gathered[first]
    off = np.zeros(len(points))
    np.maximum.at(off, corner, np.abs(gathered[:, 2] / points[corner, 2] - 1))
    column, row = points[:, :2].astype(int).T
    kept: Points = points[(off < _SAME) & ((often > 1) | still[row, column])]
    return kept


def as_maps(points: dict[int, Points], frames: int, height: int, width: int) -> Float32[ndarray, "t h w"]:
    """Points as z-depth (m) of the pixels on which they lie, 0 elsewhere."""
    z = np.zeros((frames, height, width), np.float32)
    for frame, cloud in points.items():
        x, y = cloud[:, :2].astype(int).T
        z[frame, y, x] = cloud[:, 2]
    return z


def spread_out(points: dict[int, Points], camera: CameraTrack) -> Float32[ndarray, "t h w"]:
    """z-depth (m) of all pixels of all frames: inverse depth is interpolated between the points of frames nearby.

    Smooth, with nothing of the shape between the points.
    """
    everywhere = np.ones((camera.height, camera.width), bool)
    return np.stack([spread(seen, everywhere) for seen in _seen(points, camera)])


def bent_to(
    depth: Float32[ndarray, "t h w"], points: dict[int, Points], camera: CameraTrack, instances: Instances
) -> Float32[ndarray, "t h w"]:
    """Depth (m) of another kind times a factor that varies smoothly, by which points of what stands still are off it.

    A network's errors are of that kind: a slope, a bulge. Points that are far off are of other surfaces, and where
    there are few, there is little change.
    """
    sigma = _BENT_OVER * camera.width
    alone = 1 / (2 * np.pi * sigma**2)  # what a single point weighs after the blur, on itself
    bent = np.zeros_like(depth)
    for frame, seen in enumerate(_seen(points, camera)):
        column, row = seen[:, :2].astype(int).T
        z = depth[frame, row, column]
        known = (z > 0) & (instances[frame, row, column] == 0)
        off = np.log(seen[known, 2] / z[known])
        usual = np.abs(off) < _BENT_BY
        total, count = np.zeros((2, *depth.shape[1:]), np.float32)
        at = row[known][usual], column[known][usual]
        np.add.at(total, at, off[usual])
        np.add.at(count, at, 1)
        smooth = cv2.GaussianBlur(total, (0, 0), sigma) / (cv2.GaussianBlur(count, (0, 0), sigma) + _HELD * alone)
        bent[frame] = depth[frame] * np.exp(smooth)
    return bent


def _seen(points: dict[int, Points], camera: CameraTrack) -> Iterator[Points]:
    """At each frame, the points of those nearby: where they are seen, and how far away."""
    pose = camera.world_from_camera.double().numpy()
    K = camera.intrinsics.double().numpy()
    world = {}
    for frame, cloud in points.items():
        rays = np.c_[cloud[:, :2], np.ones(len(cloud))] @ np.linalg.inv(K[frame]).T
        world[frame] = rays * cloud[:, 2:] @ pose[frame, :3, :3].T + pose[frame, :3, 3]
    frames, size = len(camera), (camera.width, camera.height)
    for frame in range(frames):
        away = sorted((abs(other - frame), other) for other in world)
        near = [world[other] for i, (apart, other) in enumerate(away) if i < _NEAREST or apart <= _NEAR * frames]
        seen = (np.concatenate(near) - pose[frame, :3, 3]) @ pose[frame, :3, :3] @ K[frame].T
        seen = seen[seen[:, 2] > 0]
        xy = seen[:, :2] / seen[:, 2:]
        inside = ((xy >= 0) & (xy < size)).all(1)
        yield np.c_[xy, seen[:, 2]][inside].astype(np.float32)
