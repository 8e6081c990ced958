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
from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import transform_points, unproject_image
from lerobot_msdyn.core.observations import Priors, View
from lerobot_msdyn.core.sampling import evenly, scaled_px, scaled_window
from lerobot_msdyn.core.visibility import projected
from lerobot_msdyn.priors.fused_frames import EXACT, Fused, Source, fused, tolerance_of, usual_difference
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
    def source(self) -> Source:
        """What it knows, as a frame that is fused."""
        return Source.of(self.empty.rgb.numpy(), self.empty.depth.masked_fill(self.empty.seen == 0, 0.0), self.camera)

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """The new surface points, m, in the world."""
        return transform_points(self.camera.world_from_camera[0], self.in_camera[self.new])


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
    tolerance = tolerance_of(difference)
    rest = [sources[i] for i in evenly(len(sources), CANDIDATES).tolist()]
    middle = _middle(view.camera, look_at_distance(priors.depth[0]))
    first = min(rest, key=lambda source: _apart(source.camera, middle))
    fusing = Fusing(sources, tolerance, exact=difference < EXACT)
    found = with_further([fusing.key_view(first, [])], [source for source in rest if source is not first], fusing)
    logger.info(
        "background: %d key views, %d surface elements; depths of frames differ by %.2f %%",
        len(found),
        sum(int(key.new.sum()) for key in found),
        100 * difference,
    )
    return tuple(found)


@dataclass(frozen=True)
class Fusing:
    """How frames become key views."""

    sources: Sequence[Source]  # that are fused
    tolerance: float  # relative difference of depths up to which they are of one surface
    exact: bool  # whether a frame's own depth is better than a median of several

    def key_view(self, frame: Source, earlier: Sequence[KeyView]) -> KeyView:
        """A frame as a key view, behind earlier ones."""
        empty = _continued(fused(frame, self.sources, self.tolerance, exact=self.exact))
        if not earlier:
            return KeyView(empty, frame.camera, torch.ones_like(empty.seen, dtype=torch.bool))
        known = torch.cat([key.points for key in earlier])
        new = (empty.seen > 0) & ~shown(known, frame.camera, empty.depth, self.tolerance)
        return KeyView(empty, frame.camera, new)


def with_further(
    found: Sequence[KeyView], candidates: Sequence[Source], fusing: Fusing, most: int = MOST_KEYS
) -> list[KeyView]:
    """Key views, and behind them those of the frames that show most that is lacking, until hardly anything is."""
    found, rest = [*found], [*candidates]
    while rest and len(found) < most:
        known = torch.cat([key.points for key in found])
        lacking = [_lacking(known, source, fusing.tolerance) for source in rest]
        if max(lacking) < LEAST_NEW:
            break
        chosen = rest.pop(int(np.argmax(lacking)))
        found.append(fusing.key_view(chosen, found))
    return found


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
        sources.append(Source.of(view.rgb[frame].numpy(), depth, view.camera.select([frame])))
    return sources


def _continued(fused: Fused) -> EmptyScene:
    """What was never seen gets the colours around it."""
    unknown, picture = fused.seen == 0, fused.rgb
    if bool(unknown.any()) and not bool(unknown.all()):
        radius_px = max(LEAST_RADIUS_PX, scaled_px(INPAINT_RADIUS_PX, unknown.shape[1]))
        mask = unknown.numpy().astype(np.uint8)
        picture = torch.from_numpy(cv2.inpaint(picture.numpy(), mask, radius_px, cv2.INPAINT_TELEA))
    return EmptyScene(picture, fused.depth, fused.seen)


def shown(
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
    lacking = (source.depth > 0) & ~shown(known, source.camera, source.depth, tolerance)
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
