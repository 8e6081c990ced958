"""A moving camera's poses, refined: every frame is laid over what stands still, as its key views show it.

Gauss-Newton on differences of brightness with robust weights, from coarse to fine (dense visual odometry, Steinbruecker
et al. 2011), with a gain and an offset per frame. Poses are held at the given ones as far as these are trusted. Nothing
is rendered: overlapping Gaussians that are not fitted yet shift a picture by a quarter of a pixel.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, invert_se3, project, se3, transform_points
from lerobot_msdyn.core.observations import Priors, View
from lerobot_msdyn.core.sampling import scaled_px, scaled_window
from lerobot_msdyn.reconstruction.background import look_at_distance
from lerobot_msdyn.reconstruction.key_views import KeyView, key_views

logger = logging.getLogger(__name__)

BLURS_PX = (6.0, 3.0, 1.5, 1.5, 1.5)  # of 320: standard deviations; an iteration at each
MASK_MARGIN_PX = 3  # of 320: what moves bleeds so far
BEHIND = 0.05  # share of a frame's depth by which a point is hidden
POINTS = 8_000  # that are compared, at most
LEAST_POINTS = 300
TRUST_TURN, TRUST_SHIFT = 0.02, 0.02  # standard deviations of the given poses: rad, and share of the look-at distance
TRUST_GAIN, TRUST_OFFSET = 0.5, 20.0  # and of a frame's brightness: relative, and grey levels
ROBUST = 1.5  # times the usual difference, from which differences count less
LEAST_GREY = 1.0  # grey levels; the usual difference is not taken to be smaller
CAPPED_GREY = 30.0  # larger differences are of other things


@dataclass(frozen=True)
class _Surface:
    """What stands still: points and their brightness, as blurred as the frames that are compared with them."""

    points: Float[Tensor, "n 3"]  # m, world
    grey: Float32[ndarray, "b n"]  # 0..255, per blur

    @classmethod
    def of(cls, keys: Sequence[KeyView]) -> "_Surface":
        """That of key views; of many points some."""
        points, grey = [], []
        for key in keys:
            chosen = key.new & (key.empty.seen > 0)
            in_key = transform_points(key.camera.world_from_camera[0], key.in_camera[chosen])
            points.append(in_key)
            picture = key.empty.rgb.numpy().astype(np.float32).mean(-1)
            grey.append(np.stack([image[chosen.numpy()] for image in _blurred(picture)]))
        together = np.concatenate(grey, axis=1)
        step = max(1, together.shape[1] // POINTS)
        return cls(torch.cat(points)[::step], together[:, ::step])


@dataclass(frozen=True)
class _Frame:
    """A frame that is laid over."""

    grey: list[Float32[ndarray, "h w"]]  # per blur
    depth: Float32[ndarray, "h w"]  # m; 0 where something moves, or where it is not known
    intrinsics: Float[Tensor, "3 3"]


def keys_and_poses(view: View, priors: Priors, *, refine: bool) -> tuple[View, tuple[KeyView, ...]]:
    """What stands still in a video, and the video with the poses of its camera, refined if that is wanted.

    Args:
        view: the video, at the size at which it is fitted.
        priors: its depth and what moves.
        refine: whether poses of a camera that moves are refined.
    """
    keys = key_views(view, priors)
    if refine and not view.camera.is_static:
        distance = look_at_distance(keys[0].empty.depth)
        view = replace(view, camera=aligned_poses(keys, view, priors, distance))
        keys = key_views(view, priors)
    return view, keys


def aligned_poses(keys: Sequence[KeyView], view: View, priors: Priors, distance: float) -> CameraTrack:
    """The camera with the poses at which what stands still looks most like each frame; those that gain nothing stay.

    Args:
        keys: what stands still.
        view: the video; its camera has the poses to begin with.
        priors: its depth and what moves.
        distance: m, to the look-at point.
    """
    camera, moved = laid_over(keys, view, priors.depth, priors.instances, distance)
    width = view.camera.width
    logger.info("poses: refined by %.2f px (median) and %.2f px (at most), of %d", np.median(moved), max(moved), width)
    return camera


@torch.no_grad()
def laid_over(
    keys: Sequence[KeyView],
    view: View,
    depth: Float[Tensor, "t h w"],
    instances: UInt8[Tensor, "t h w"],
    distance: float,
) -> tuple[CameraTrack, list[float]]:
    """As `aligned_poses`, by depth (m) and what moves; and by how many pixels (median) each picture goes."""
    surface = _Surface.of(keys)
    poses, moved = view.camera.world_from_camera.clone(), []
    for t in range(len(view)):
        mask = (instances[t] > 0).numpy().astype(np.uint8)
        still = cv2.dilate(mask, scaled_window(MASK_MARGIN_PX, mask.shape[1])) == 0
        frame = _Frame(
            _blurred(view.rgb[t].numpy().astype(np.float32).mean(-1)),
            depth[t].numpy() * still,
            view.camera.intrinsics[t],
        )
        poses[t], by_px = _aligned(surface, frame, poses[t], distance)
        moved.append(by_px)
    return replace(view.camera, world_from_camera=poses), moved


def _blurred(picture: Float32[ndarray, "h w"]) -> list[Float32[ndarray, "h w"]]:
    by_px = {blur: cv2.GaussianBlur(picture, (0, 0), scaled_px(blur, picture.shape[1])) for blur in set(BLURS_PX)}
    return [by_px[blur] for blur in BLURS_PX]


def _aligned(
    surface: _Surface, frame: _Frame, given: Float[Tensor, "4 4"], distance: float
) -> tuple[Float[Tensor, "4 4"], float]:
    """The best pose of one frame, and by how much (px) the picture goes by it."""
    trust = np.array([TRUST_TURN] * 3 + [TRUST_SHIFT * distance] * 3 + [TRUST_GAIN, TRUST_OFFSET])
    prior, total = np.diag(trust**-2.0), np.zeros(8)
    for blur in range(len(BLURS_PX)):
        now = _linear(surface, frame, _turned(given, total), total, blur)
        if now is None:
            return given, 0.0
        total = total + np.linalg.solve(now.hessian + prior, now.gradient - prior @ total)
    brightness = np.concatenate((np.zeros(6), total[6:]))
    before = _linear(surface, frame, given, brightness, len(BLURS_PX) - 1)
    after = _linear(surface, frame, _turned(given, total), total, len(BLURS_PX) - 1)
    if before is None or after is None or after.cost >= before.cost:
        return given, 0.0
    best = _turned(given, total)
    return best, _way_px(surface.points, frame, given, best)


@dataclass(frozen=True)
class _Linear:
    """How the brightness of a frame differs from that of the surface, and how that depends on the pose."""

    cost: float  # robust mean difference, grey levels
    hessian: Float64[ndarray, "8 8"]
    gradient: Float64[ndarray, "8"]


def _linear(
    surface: _Surface, frame: _Frame, pose: Float[Tensor, "4 4"], total: Float64[ndarray, "8"], blur: int
) -> _Linear | None:
    """Normal equations of a further turn (rad) and shift (m) in the camera's axes, a gain and an offset.

    None where too little of the surface is seen.
    """
    gain, offset = 1 + total[6], total[7]
    in_camera = transform_points(invert_se3(pose), surface.points)
    xy, _ = project(in_camera, frame.intrinsics)
    there, points = xy.numpy() - np.float32(0.5), in_camera.numpy().astype(np.float64)
    height, width = frame.depth.shape
    inside = (points[:, 2] > 0) & (there >= 0).all(1) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)
    rows = np.flatnonzero(inside)
    depth = frame.depth[tuple(there[rows].round().astype(int)[:, ::-1].T)]
    rows = rows[np.abs(points[rows, 2] - depth) < BEHIND * depth]
    if len(rows) < LEAST_POINTS:
        return None
    picture = frame.grey[blur]
    slopes = (cv2.Sobel(picture, cv2.CV_32F, x, y, ksize=3, scale=1 / 8) for x, y in ((1, 0), (0, 1)))
    theirs, dx, dy = (_at(image, there[rows]).astype(np.float64) for image in (picture, *slopes))
    ours, seen = surface.grey[blur][rows].astype(np.float64), points[rows]
    x, y, z = seen.T
    fx, fy = float(frame.intrinsics[0, 0]), float(frame.intrinsics[1, 1])
    by_x, by_y = dx * fx / z, dy * fy / z
    flow = np.stack((by_x, by_y, -(by_x * x + by_y * y) / z), axis=1)
    # A camera that turns by w and shifts by v sees a point go by -(w x point) - v.
    jacobian = np.concatenate((-np.cross(seen, flow), -flow, -ours[:, None], -np.ones((len(rows), 1))), axis=1)
    residual = gain * ours + offset - theirs
    scale = max(1.4826 * float(np.median(np.abs(residual))), LEAST_GREY)
    weighted = jacobian * (np.minimum(1.0, ROBUST * scale / np.abs(residual).clip(min=1e-6)) / scale**2)[:, None]
    cost = float(np.abs(residual).clip(max=CAPPED_GREY).mean())
    return _Linear(cost, weighted.T @ jacobian, weighted.T @ residual)


def _at(image: Float32[ndarray, "h w"], places: Float32[ndarray, "n 2"]) -> Float32[ndarray, " n"]:
    """Values between pixels (linear)."""
    left, top = np.floor(places).astype(int).T
    right, bottom = (left + 1).clip(max=image.shape[1] - 1), (top + 1).clip(max=image.shape[0] - 1)
    x, y = (places - np.floor(places)).T
    upper = image[top, left] * (1 - x) + image[top, right] * x
    return np.asarray(upper * (1 - y) + (image[bottom, left] * (1 - x) + image[bottom, right] * x) * y)


def _turned(pose: Float[Tensor, "4 4"], by: Float64[ndarray, "8"]) -> Float[Tensor, "4 4"]:
    """A pose turned and shifted in its own axes."""
    turn = axis_angle_to_matrix(torch.from_numpy(by[None, :3]))[0]
    return (pose.double() @ se3(turn, torch.from_numpy(by[3:6]))).float()


def _way_px(
    points: Float[Tensor, "n 3"], frame: _Frame, one: Float[Tensor, "4 4"], other: Float[Tensor, "4 4"]
) -> float:
    """How far (px, median) the picture goes from one pose to another."""
    (before, z), (after, _) = (
        project(transform_points(invert_se3(pose), points), frame.intrinsics) for pose in (one, other)
    )
    ahead = z > 0
    return float((after - before)[ahead].norm(dim=-1).median()) if bool(ahead.any()) else 0.0
