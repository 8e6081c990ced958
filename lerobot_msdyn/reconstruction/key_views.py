"""What stands still, as a camera sees it from a few of its places: all frames fused through its poses.

A fixed camera has one place. Of one that moves, frames are chosen until hardly any surface is left that none of them
shows (key frames); each is freed of what moves before it, and fused with all others: depth is the nearest surface on
which frames agree and through which few of them see, colour the median over the frames that see it. Each key view adds
the surfaces that those before it do not show, so that there is one Gaussian per resolved surface element.
"""

import logging
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
from lerobot_msdyn.core.observations import Priors, View
from lerobot_msdyn.core.sampling import evenly, scaled_px, scaled_window
from lerobot_msdyn.core.visibility import Projection, projected
from lerobot_msdyn.reconstruction.background import (
    INPAINT_RADIUS_PX,
    LEAST_RADIUS_PX,
    MARGIN_PX,
    EmptyScene,
    empty_scene,
    fill_depth,
    look_at_distance,
    pixel_gaussians,
)
from lerobot_msdyn.scene.gaussians import Gaussians, concatenate

logger = logging.getLogger(__name__)

SOURCES = 40  # frames that are fused
CANDIDATES = 24  # frames among which key frames are looked for
MOST_KEYS = 12
LEAST_NEW = 0.004  # share of a frame that no key view shows, for which it becomes one
SPREAD, TOLERANCES = 4.0, (0.01, 0.1)  # depths agree within so many times their usual difference; its bounds, relative
SUPPORT, LEAST_SUPPORT = 0.2, 2  # share and number of the depths at a pixel that make a surface
ROUNDS = 4  # in which surfaces through which frames see are given up
EXACT = 0.005  # usual relative difference of depths, up to which a frame's own is better than a median


@dataclass(frozen=True)
class KeyView:
    """What stands still, as it is seen from one place."""

    empty: EmptyScene
    camera: CameraTrack  # of one frame
    new: Bool[Tensor, "h w"]  # which pixels show a surface that earlier key views do not show

    @property
    def in_camera(self) -> Float[Tensor, "h w 3"]:
        """The surface point of every pixel, m, in the camera's axes; where depth is not known, at a guessed one."""
        return unproject_image(fill_depth(self.empty.depth), self.camera.intrinsics[0])

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """The new surface points, m, in the world."""
        return transform_points(self.camera.world_from_camera[0], self.in_camera[self.new])


@dataclass(frozen=True)
class Source:
    """A frame that is fused."""

    rgb: UInt8[ndarray, "h w 3"]
    depth: Float[Tensor, "h w"]  # m; 0 where it is unknown, or where something moves close by
    camera: CameraTrack  # of this frame
    points: Float[Tensor, "n 3"]  # of the pixels whose depth is known, m, in the world

    def sees(self, seen: Projection, tolerance: float) -> Bool[Tensor, " n"]:
        """Which points are what this frame shows at their pixels."""
        depth = self.depth[seen.pixel]
        return seen.inside & (depth > 0) & ((seen.z - depth).abs() < tolerance * depth)

    def sees_through(self, seen: Projection, tolerance: float) -> Bool[Tensor, " n"]:
        """Before which points this frame shows nothing, but something behind them."""
        return seen.inside & (seen.z < (1 - tolerance) * self.depth[seen.pixel])


def fixed_view(empty: EmptyScene, camera: CameraTrack) -> tuple[KeyView, ...]:
    """The one key view of a camera that stands still."""
    return (KeyView(empty, camera.select([0]), torch.ones_like(empty.seen, dtype=torch.bool)),)


def key_views(view: View, priors: Priors) -> tuple[KeyView, ...]:
    """What stands still in a video, from one place if its camera stands still, else from as many as it takes.

    Args:
        view: the video, at the size at which it is fitted.
        priors: its depth and what moves, at the same size.
    """
    if view.camera.is_static:
        return fixed_view(empty_scene(view.rgb, priors.depth, priors.instances), view.camera)
    sources = _sources(view, priors)
    difference = usual_difference(sources)
    tolerance = min(max(SPREAD * difference, TOLERANCES[0]), TOLERANCES[1])
    rest = [sources[i] for i in evenly(len(sources), CANDIDATES).tolist()]
    middle = _middle(view.camera, look_at_distance(priors.depth[0]))
    chosen = min(rest, key=lambda source: _apart(source.camera, middle))
    found: list[KeyView] = []
    while True:
        empty = fused(chosen, sources, tolerance, exact=difference < EXACT)
        if found:
            known = torch.cat([key.points for key in found])
            new = (empty.seen > 0) & ~_shown(known, chosen.camera, empty.depth, tolerance)
        else:
            new = torch.ones_like(empty.seen, dtype=torch.bool)
        found.append(KeyView(empty, chosen.camera, new))
        rest = [source for source in rest if source is not chosen]
        if not rest or len(found) == MOST_KEYS:
            break
        known = torch.cat([key.points for key in found])
        lacking = [_lacking(known, source, tolerance) for source in rest]
        if max(lacking) < LEAST_NEW:
            break
        chosen = rest[int(np.argmax(lacking))]
    logger.info(
        "background: %d key views, %d surface elements; depths of frames differ by %.2f %%",
        len(found),
        sum(int(key.new.sum()) for key in found),
        100 * difference,
    )
    return tuple(found)


def static_gaussians(keys: Sequence[KeyView], most: int) -> Gaussians:
    """One flat Gaussian per new pixel of the key views; for each of them at most `most`, else every second, ..."""
    parts = []
    for key in keys:
        step = max(1, int(np.ceil(np.sqrt(key.new.numel() / most))))
        pixels, _ = pixel_gaussians(key.empty.rgb, fill_depth(key.empty.depth), key.camera, 0, step)
        parts.append(pixels.select(key.new[step // 2 :: step, step // 2 :: step].reshape(-1)))
    return concatenate(parts) if len(parts) > 1 else parts[0]


def _sources(view: View, priors: Priors) -> list[Source]:
    """Evenly spread frames, without what moves."""
    window = scaled_window(MARGIN_PX, view.camera.width)
    sources = []
    for frame in evenly(len(view), SOURCES).tolist():
        moving = cv2.dilate((priors.instances[frame] > 0).numpy().astype(np.uint8), window) > 0
        depth = priors.depth[frame].masked_fill(torch.from_numpy(moving), 0.0)
        camera = view.camera.select([frame])
        in_camera = unproject_image(depth, camera.intrinsics[0])[depth > 0]
        points = transform_points(camera.world_from_camera[0], in_camera)
        sources.append(Source(view.rgb[frame].numpy(), depth, camera, points))
    return sources


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


def fused(key: Source, sources: Sequence[Source], tolerance: float, *, exact: bool) -> EmptyScene:
    """The empty scene of one frame, by all frames.

    Args:
        key: the frame.
        sources: all frames, this one among them.
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
    unknown = seen_in == 0
    if unknown.any() and not unknown.all():
        radius_px = max(LEAST_RADIUS_PX, scaled_px(INPAINT_RADIUS_PX, width))
        picture = cv2.inpaint(picture, unknown.astype(np.uint8), radius_px, cv2.INPAINT_TELEA)
    depth = depth.masked_fill(torch.from_numpy(unknown), 0.0)
    return EmptyScene(torch.from_numpy(picture), depth, torch.from_numpy(seen_in))


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
    places = np.nan_to_num(xy.numpy().astype(np.float32)) - 0.5
    columns = 1024  # rows of points: OpenCV takes no image side over 32767
    padded = np.pad(places, ((0, -len(places) % columns), (0, 0))).reshape(-1, columns, 2)
    colours = cv2.remap(picture, padded, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(colours.reshape(-1, 3)[: len(places)])


def _shown(
    points: Float[Tensor, "n 3"], camera: CameraTrack, depth: Float[Tensor, "h w"], tolerance: float
) -> Bool[Tensor, "h w"]:
    """Pixels of a view with this depth (m) whose surface is among some points (m, world), or beside one."""
    seen = projected(points, camera)
    surface = depth[seen.pixel]
    on_it = seen.inside & (surface > 0) & ((seen.z - surface).abs() < tolerance * surface)
    row, column = (index[on_it] for index in seen.pixel)
    shown = np.zeros(tuple(depth.shape), np.uint8)
    shown[row.numpy(), column.numpy()] = 1
    return torch.from_numpy(cv2.dilate(shown, np.ones((3, 3), np.uint8)) > 0)


def _lacking(known: Float[Tensor, "n 3"], source: Source, tolerance: float) -> float:
    """Share of a frame's pixels that show a surface which is not known."""
    lacking = (source.depth > 0) & ~_shown(known, source.camera, source.depth, tolerance)
    solid = cv2.morphologyEx(lacking.numpy().astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return float(solid.mean())


def _middle(camera: CameraTrack, distance: float) -> Float[Tensor, "2 3"]:
    """The usual place of a camera and the point at a distance (m) that it usually looks at."""
    poses = camera.world_from_camera
    return torch.stack((poses[:, :3, 3], poses[:, :3, 3] + distance * poses[:, :3, 2])).median(1).values


def _apart(camera: CameraTrack, middle: Float[Tensor, "2 3"]) -> float:
    """How far (m) a pose is from a usual one, in place and sight."""
    place, sight = camera.world_from_camera[0, :3, 3], camera.world_from_camera[0, :3, 2]
    distance = (middle[1] - middle[0]).norm()
    return float((place - middle[0]).norm() + (place + distance * sight - middle[1]).norm())
