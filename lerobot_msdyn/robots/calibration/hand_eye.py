"""A camera that rides on a link: where it sits on it, by the link's poses and how the ground goes by in its pictures.

Corners are followed from frame to frame. Where the joints say that the link goes from one pose to another, a corner on
the ground (a plane, level in the robot's world) has one place in the second picture for each hand-eye pose, focal
length, height of the ground and lag of the video behind the joints; those are found by robust least squares. Things
that stand on the ground, or that the gripper holds, are outliers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float64, UInt8
from numpy import ndarray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from lerobot_msdyn.core.corners import corners_followed
from lerobot_msdyn.core.errors import PriorError

GAPS_S = (0.4, 0.8, 1.2)  # from a frame to the others in which its corners are looked for
STARTS = 40  # frames, evenly spread over all videos, whose corners are followed
LEAST_MATCHES = 200
LEAST_FLOW_PX = 1.0  # of 320: corners that go less tell nothing
TURNS_DEG = (0, 90, 180, 270)  # about the link's axis, from which the search starts; and the axis either way
ROBUST_PX = 1.0  # of 320
FOCAL_SD, SHIFT_SD_M, GROUND_SD_M, LAG_SD_S = 0.15, 0.15, 0.5, 0.5  # how far they may be from where the search starts
MOST_LAG_S = 2.0
MOST_PX = 3.0  # of 320, median: worse is no solution
NEAR_M, FAR_M = 0.02, 5.0


@dataclass(frozen=True)
class HandEye:
    """A camera on a link."""

    link_from_camera: Float64[ndarray, "4 4"]  # m, OpenCV axes
    focal_px: float
    ground_m: float  # height of the ground in the robot's world
    lag_s: float  # so much later than the picture the joints are recorded; negative: earlier
    error_px: float  # median, of the corners' places

    def poses(self, world_from_link: Float64[ndarray, "t 4 4"], fps: int | float) -> Float64[ndarray, "t 4 4"]:
        """World from camera at every frame, by the link's recorded poses."""
        return _at_lag(world_from_link, self.lag_s * fps) @ self.link_from_camera

    def ground_depth(
        self, world_from_camera: Float64[ndarray, "t 4 4"], width: int, height: int
    ) -> Float64[ndarray, "t {height} {width}"]:
        """Z-depth (m) of the ground in every picture; 0 where it is not seen."""
        grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
        rays = _rays(grid.reshape(-1, 2), self.focal_px, (width, height)) @ world_from_camera[:, 2:, :3].swapaxes(1, 2)
        down = rays[..., 0].reshape(len(world_from_camera), height, width)
        depth = (self.ground_m - world_from_camera[:, 2, 3])[:, None, None] / np.where(down < -1e-6, down, np.inf)
        return np.where((depth > NEAR_M) & (depth < FAR_M), depth, 0.0)


def solve_hand_eye(
    rgb: Sequence[UInt8[ndarray, "_ h w 3"]],
    world_from_link: Sequence[Float64[ndarray, "_ 4 4"]],
    fps: int | float,
    horizontal_fov_deg: float = 60.0,
) -> HandEye:
    """The camera of one or more videos whose link has these poses (m; the world's z axis is up).

    Args:
        rgb: the frames of each video, all of one size.
        world_from_link: the link's poses at these frames, by the joints.
        fps: of the videos.
        horizontal_fov_deg: about what the camera has.

    Raises:
        PriorError: too few corners can be followed while the link moves, or no camera explains where they go.
    """
    height, width = rgb[0].shape[1:3]
    first, second, here, there = _matches(rgb, fps)
    far = np.linalg.norm(there - here, axis=1) > LEAST_FLOW_PX * width / 320
    if far.sum() < LEAST_MATCHES:
        raise PriorError(
            f"hand-eye: {far.sum()} corners could be followed while the picture moves, expected {LEAST_MATCHES} or "
            "more: give the camera's poses by --camera.poses FILE.npz"
        )
    first, second, here, there = (part[far] for part in (first, second, here, there))
    focal = width / 2 / math.tan(math.radians(horizontal_fov_deg) / 2)
    spread = np.array([9.0] * 3 + [SHIFT_SD_M] * 3 + [FOCAL_SD, GROUND_SD_M, LAG_SD_S])
    unit = ROBUST_PX * width / 320

    def placed(x: Float64[ndarray, "9"]) -> Float64[ndarray, "n 2"]:
        frames = float(np.clip(x[8], -MOST_LAG_S, MOST_LAG_S)) * fps
        cameras = np.concatenate([_at_lag(poses, frames) for poses in world_from_link]) @ _pose(x[:6])
        return _followed(cameras[first], cameras[second], here, math.exp(x[6]), x[7], (width, height))

    best, cost = None, np.inf
    for start in _starts(focal):

        def residual(x: Float64[ndarray, "9"], start: Float64[ndarray, "9"] = start) -> Float64[ndarray, " r"]:
            away = (placed(x) - there).clip(-100 * unit, 100 * unit) / unit
            return np.concatenate((away.reshape(-1), (x - start) / spread))

        found = least_squares(residual, start, loss="soft_l1", max_nfev=150)
        if found.cost < cost:
            best, cost = found.x, found.cost
    assert best is not None
    error = float(np.median(np.linalg.norm(placed(best) - there, axis=1)))
    if error > MOST_PX * width / 320:
        raise PriorError(
            f"hand-eye: corners of the ground are {error:.1f} px from where the joints put them; expected "
            f"{MOST_PX * width / 320:.1f} or less: is the camera on this link, and is there a ground to be seen?"
        )
    return HandEye(_pose(best[:6]), math.exp(best[6]), float(best[7]), float(best[8]), error)


def _starts(focal_px: float) -> list[Float64[ndarray, "9"]]:
    """Cameras that look along the link's z axis or against it, turned about it."""
    starts = []
    for flip in (0, 180):
        for turn in TURNS_DEG:
            rotation = Rotation.from_euler("zx", (turn, flip), degrees=True)
            starts.append(np.array([*rotation.as_rotvec(), 0.0, 0.0, 0.0, math.log(focal_px), 0.0, 0.0]))
    return starts


def _matches(rgb: Sequence[UInt8[ndarray, "_ h w 3"]], fps: int | float) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Frames, counted through all videos, and places (px) of corners, two by two."""
    parts: list[tuple[ndarray, ...]] = []
    begin = 0
    for video in rgb:
        grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in video]
        for gap in sorted({max(1, round(seconds * fps)) for seconds in GAPS_S}):
            starts = np.linspace(0, max(len(video) - 1 - gap, 0), -(-STARTS // len(rgb))).round().astype(int)
            for start in np.unique(starts).tolist():
                if start + gap < len(video):
                    here, there = corners_followed(grey[start], grey[start + gap])
                    frame = np.full(len(here), begin + start)
                    parts.append((frame, frame + gap, here + 0.5, there + 0.5))
        begin += len(video)
    if not parts:
        none = np.zeros(0, int)
        return none, none, np.zeros((0, 2)), np.zeros((0, 2))
    first, second, here, there = (np.concatenate(part) for part in zip(*parts, strict=True))
    return first, second, here.astype(np.float64), there.astype(np.float64)


def _pose(x: Float64[ndarray, "6"]) -> Float64[ndarray, "4 4"]:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]
    return out


def _at_lag(poses: Float64[ndarray, "t 4 4"], frames: float) -> Float64[ndarray, "t 4 4"]:
    """Poses so many frames later, between recorded ones; held at the ends."""
    if len(poses) < 2:
        return poses
    time = np.clip(np.arange(len(poses)) + frames, 0, len(poses) - 1)
    before = np.minimum(time.astype(int), len(poses) - 2)
    share = time - before
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    one, other = poses[before], poses[before + 1]
    way = Rotation.from_matrix(one[:, :3, :3].swapaxes(1, 2) @ other[:, :3, :3]).as_rotvec()
    out[:, :3, :3] = one[:, :3, :3] @ Rotation.from_rotvec(way * share[:, None]).as_matrix()
    out[:, :3, 3] = one[:, :3, 3] + share[:, None] * (other[:, :3, 3] - one[:, :3, 3])
    return out


def _rays(xy: Float[ndarray, "n 2"], focal_px: float, size: tuple[int, int]) -> Float64[ndarray, "n 3"]:
    return np.concatenate(((xy - np.array(size) / 2) / focal_px, np.ones((len(xy), 1))), axis=1)


def _followed(
    one: Float64[ndarray, "n 4 4"],
    other: Float64[ndarray, "n 4 4"],
    xy: Float64[ndarray, "n 2"],
    focal_px: float,
    ground_m: float,
    size: tuple[int, int],
) -> Float64[ndarray, "n 2"]:
    """Where points of the ground that one camera sees at some pixels are in another's picture (px)."""
    rays = (one[:, :3, :3] @ _rays(xy, focal_px, size)[..., None])[..., 0]
    down = np.where(np.abs(rays[:, 2]) < 1e-3, -1e-3, rays[:, 2])
    depth = ((ground_m - one[:, 2, 3]) / down).clip(NEAR_M, FAR_M)
    points = one[:, :3, 3] + depth[:, None] * rays
    seen = (other[:, :3, :3].swapaxes(1, 2) @ (points - other[:, :3, 3])[..., None])[..., 0]
    return focal_px * seen[:, :2] / seen[:, 2:].clip(min=1e-3) + np.array(size) / 2
