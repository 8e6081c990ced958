"""One frame as several frames of a camera that moves show it together: without what moves, where they look past it.

Depth is the nearest surface on which frames agree and through which no more of them see; colour is the median over the
frames that see it. Poses and depth carry everything, so that parallax does not matter.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import transform_points, unproject_image
from lerobot_msdyn.core.images import masked_median
from lerobot_msdyn.core.visibility import Projection, projected

SPREAD, TOLERANCES = 4.0, (0.01, 0.1)  # depths agree within so many times their usual difference; its bounds, relative
SUPPORT, LEAST_SUPPORT = 0.2, 2  # share and number of the depths at a pixel that make a surface
ROUNDS = 4  # in which surfaces through which frames see are given up
EXACT = 0.005  # usual relative difference of depths, up to which a frame's own is better than a median


@dataclass(frozen=True)
class Source:
    """A frame that is fused."""

    rgb: UInt8[ndarray, "h w 3"]
    depth: Float[Tensor, "h w"]  # m; 0 where it is unknown, or where something moves close by
    camera: CameraTrack  # of this frame
    points: Float[Tensor, "n 3"]  # of the pixels whose depth is known, m, in the world

    @classmethod
    def of(cls, rgb: UInt8[ndarray, "h w 3"], depth: Float[Tensor, "h w"], camera: CameraTrack) -> "Source":
        """A frame, by its picture, its depth and its pose."""
        in_camera = unproject_image(depth, camera.intrinsics[0])[depth > 0]
        return cls(rgb, depth, camera, transform_points(camera.world_from_camera[0], in_camera))

    def sees(self, seen: Projection, tolerance: float) -> Bool[Tensor, " n"]:
        """Which points are what this frame shows at their pixels."""
        depth = self.depth[seen.pixel]
        return seen.inside & (depth > 0) & ((seen.z - depth).abs() < tolerance * depth)

    def sees_through(self, seen: Projection, tolerance: float) -> Bool[Tensor, " n"]:
        """Before which points this frame shows nothing, but something behind them."""
        return seen.inside & (seen.z < (1 - tolerance) * self.depth[seen.pixel])


@dataclass(frozen=True)
class Fused:
    """What a frame shows of what stands still."""

    rgb: UInt8[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]  # m, 0 = unknown
    seen: Int[Tensor, "h w"]  # frames that show it; 0 = none, colour and depth are unknown


def usual_difference(sources: Sequence[Source]) -> float:
    """Median relative difference of a frame's depth to that of the others at the same points: errors of depth and pose.

    What lies farther apart than surfaces do that hide each other is not counted.
    """
    middle = sources[len(sources) // 2]
    differences = []
    for source in sources:
        if source is not middle:
            seen = projected(middle.points, source.camera)
            depth = source.depth[seen.pixel]
            both = seen.inside & (depth > 0)
            differences.append((seen.z[both] / depth[both]).log().abs())
    known = torch.cat(differences) if differences else torch.zeros(0)
    return float(known.median()) if len(known) else 0.0


def tolerance_of(difference: float) -> float:
    """Relative difference up to which depths are of one surface, by what is usual."""
    return min(max(SPREAD * difference, TOLERANCES[0]), TOLERANCES[1])


def fused(key: Source, sources: Sequence[Source], tolerance: float, *, exact: bool) -> Fused:
    """One frame, by several.

    Args:
        key: the frame.
        sources: those that are fused; it may be among them.
        tolerance: relative difference of depths up to which they are of one surface.
        exact: whether the frame's own depth is better than a median of several.
    """
    height, width = key.depth.shape
    laid = np.stack([key.depth.numpy() if source is key else _laid(source, key) for source in sources])
    depth = _agreed(laid, key, sources, tolerance)
    if exact:
        depth = torch.where((key.depth - depth).abs() < tolerance * depth, key.depth, depth)
    known = depth > 0
    in_camera = unproject_image(depth, key.camera.intrinsics[0])[known]
    points = transform_points(key.camera.world_from_camera[0], in_camera)
    colours, usable = np.zeros((len(sources), len(points), 3), np.uint8), np.zeros((len(sources), len(points)), bool)
    for i, source in enumerate(sources):
        seen = projected(points, source.camera)
        usable[i] = source.sees(seen, tolerance).numpy()
        colours[i] = _sampled(source.rgb, seen.xy)
    picture, seen_in = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.int64)
    picture[known.numpy()] = masked_median(colours, usable[..., None]).round()
    seen_in[known.numpy()] = usable.sum(0)
    depth = depth.masked_fill(torch.from_numpy(seen_in == 0), 0.0)
    return Fused(torch.from_numpy(picture), depth, torch.from_numpy(seen_in))


def _agreed(
    laid: Float32[ndarray, "s h w"], key: Source, sources: Sequence[Source], tolerance: float
) -> Float[Tensor, "h w"]:
    """The nearest depth (m) at each pixel of a frame on which others agree, and through which few see; 0 = unknown."""
    left = np.where(laid > 0, laid, np.float32(np.inf))
    depth = torch.zeros(laid.shape[1:])
    open_ = torch.ones(laid.shape[1:], dtype=torch.bool)  # pixels that are not decided
    for _ in range(ROUNDS):
        rows = open_.numpy()
        found = torch.from_numpy(_nearest_layer(left[:, rows], tolerance))
        candidate = torch.zeros_like(depth)
        candidate[open_] = found
        in_camera = unproject_image(candidate, key.camera.intrinsics[0])[open_]
        points = transform_points(key.camera.world_from_camera[0], in_camera)
        support, through = torch.zeros(2, len(points))
        for source in sources:
            seen = projected(points, source.camera)
            support += source.sees(seen, tolerance)
            through += source.sees_through(seen, tolerance)
        good = (support >= through) & (found > 0)
        depth[open_] = torch.where(good, found, 0.0)
        given_up = (found * (1 + tolerance)).numpy()
        left[:, rows] = np.where(left[:, rows] <= given_up, np.float32(np.inf), left[:, rows])
        open_[open_.clone()] = ~good & (found > 0)
        if not bool(open_.any()):
            break
    return depth


def _nearest_layer(depths: Float32[ndarray, "s n"], tolerance: float) -> Float32[ndarray, " n"]:
    """Per pixel the median of the nearest depths (m, infinite = none) that agree and are not few; 0 = none at all."""
    depths = np.sort(depths, axis=0)
    count = np.isfinite(depths).sum(0)
    needed = np.minimum(np.maximum(LEAST_SUPPORT, np.ceil(SUPPORT * count)), np.maximum(count, 1)).astype(np.int64)
    rows = np.arange(len(depths))[:, None]
    last = (rows + needed - 1).clip(max=len(depths) - 1)
    far = np.take_along_axis(depths, last, 0)
    with np.errstate(invalid="ignore"):
        agrees = (far <= depths * (1 + tolerance)) & (rows + needed <= count)
    first = np.where(agrees.any(0), agrees.argmax(0), np.maximum(count - 1, 0) // 2)
    nearest = np.take_along_axis(depths, first[None], 0)[0]
    with np.errstate(invalid="ignore"):
        inside = ((depths <= nearest * (1 + tolerance)) & (rows >= first) & np.isfinite(depths)).sum(0)
    middle = np.take_along_axis(depths, (first + np.maximum(inside - 1, 0) // 2)[None], 0)[0]
    return np.where(count > 0, middle, 0).astype(np.float32)


def _laid(source: Source, key: Source) -> Float32[ndarray, "h w"]:
    """Depth (m, 0 = none) of another frame's surface points as a frame sees them; of several at a pixel the nearest."""
    seen = projected(source.points, key.camera)
    inside = seen.inside
    row, column = (index[inside] for index in seen.pixel)
    out = torch.full((key.depth.numel(),), torch.inf)
    out.scatter_reduce_(0, row * key.depth.shape[1] + column, seen.z[inside], "amin")
    return out.masked_fill(torch.isinf(out), 0.0).reshape(key.depth.shape).numpy()


def _sampled(picture: UInt8[ndarray, "h w 3"], xy: Float[Tensor, "n 2"]) -> UInt8[ndarray, "n 3"]:
    """Colours between pixels (cubic)."""
    if len(xy) == 0:
        return np.zeros((0, 3), np.uint8)
    places = np.nan_to_num(xy.numpy().astype(np.float32)) - 0.5
    columns = 1024  # rows of points: OpenCV takes no image side over 32767
    padded = np.pad(places, ((0, -len(places) % columns), (0, 0))).reshape(-1, columns, 2)
    colours = cv2.remap(picture, padded, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(colours.reshape(-1, 3)[: len(places)])
