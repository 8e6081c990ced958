"""A reconstructed camera's video from elsewhere: pictures and their coverage, frame by frame."""

import functools
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import Fill, Recipe
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.motion.model.composed import MOST_BYTES
from lerobot_msdyn.reconstruction.result import FittedWindow, Reconstruction
from lerobot_msdyn.render.cpu.threads import each_on
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.rendering import Rendering, render_frames
from lerobot_msdyn.scene.still_view import StillView
from lerobot_msdyn.views.coverage import Coverage, Looked, coverage_of, looked
from lerobot_msdyn.views.filling import filled, missing

logger = logging.getLogger(__name__)

BATCH = 4  # frames that are rendered at a time ...
PIXELS_AT_ONCE = BATCH * 320 * 240  # ... as far as a thread of the CPU has room for them in its cache
GPU_BATCH = 16  # on a GPU, where launching kernels takes longer than running them
Rendered = tuple[Rendering, list[Coverage], Float[Tensor, "#t #h #w 3"]]  # frames, their coverage, what fills holes


@dataclass(frozen=True)
class _Still:
    """What stands still through a fixed camera, the same for all frames: nothing flickers, and it is looked up once."""

    view: StillView | None
    filling: Float[Tensor, "1 h w 3"] | None  # with its holes filled
    looked: Looked


@dataclass(frozen=True)
class Picture:
    """One frame of a new view."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]  # m, z-depth; 0 in holes, and everywhere without a true scale
    unseen: Bool[np.ndarray, "h w"]  # uncovered: what no recorded frame has shown


def new_pictures(
    scene: Reconstruction, camera: CameraTrack, frames: Tensor | None = None, *, fill: Fill = Recipe.fill
) -> Iterator[Picture]:
    """The scene through another camera, holes filled.

    Args:
        scene: the reconstructed camera.
        camera: the other one, of any size.
        frames: those that its poses belong to (int, [t]); default: all.
        fill: how holes are filled.
    """
    for pictures in _rendered(scene, camera, frames, fill, functools.partial(_composed, metric=scene.metric)):
        yield from pictures


@torch.no_grad()
def _composed(rendered: Rendered, *, metric: bool) -> list[Picture]:
    """Pictures with what is behind in their holes."""
    rendering, of_frames, behind = rendered
    composed = (rendering.rgb + missing(rendering.alpha)[..., None] * behind).clamp_(0, 1)
    rgb, depths = to_device((composed.mul_(255).round_().to(torch.uint8), rendering.depth), "cpu")
    return [
        Picture(picture.numpy(), np.where(~coverage.empty & metric, depth.numpy(), np.float32(0)), coverage.unseen)
        for picture, depth, coverage in zip(rgb, depths, of_frames, strict=True)
    ]


def log_uncovered(pictures: Iterator[Picture]) -> Iterator[Picture]:
    """The same pictures; after the last one, the share of their pixels that is uncovered is logged."""
    shares: list[float] = []
    for picture in pictures:
        shares.append(float(picture.unseen.mean()))
        yield picture
    logger.info("%.1f %% of the pixels are uncovered (worst frame %.1f %%)", 100 * np.mean(shares), 100 * max(shares))


def coverages(scene: Reconstruction, camera: CameraTrack, frames: Tensor | None = None) -> Iterator[Coverage]:
    """What is known about each pixel of another camera's frames; arguments as in `new_pictures`."""
    for _, of_frames, _ in _rendered(scene, camera, frames, "none", lambda rendered: rendered):
        yield from of_frames


def for_many_views(scene: Reconstruction, device: torch.device) -> Reconstruction:
    """The same reconstruction with all that new views need on a device; on the CPU, motion is composed once a frame."""
    room = MOST_BYTES // len(scene.windows)

    def prepared(window: FittedWindow) -> FittedWindow:
        moved, evidence = to_device((window.scene, window.evidence), device)
        return replace(window, scene=moved.composed(room), evidence=evidence)

    return replace(scene, windows=tuple(prepared(window) for window in scene.windows))


class UnseenMasks:
    """Collects, as pictures pass by, masks of what is uncovered in them."""

    def __init__(self) -> None:
        self._packed: dict[str, list[np.ndarray]] = {}
        self._width: dict[str, int] = {}

    def kept(self, key: str, pictures: Iterator[Picture]) -> Iterator[Picture]:
        """The same pictures of a camera, whose masks are kept."""
        for picture in pictures:
            self._packed.setdefault(key, []).append(np.packbits(picture.unseen, axis=-1))
            self._width[key] = picture.unseen.shape[1]
            yield picture

    def arrays(self) -> dict[str, np.ndarray]:
        """Per camera its masks, uint8 [t, h, ceil(w / 8)], eight pixels of a row to a byte; and NAME.width, px."""
        masks = {key: np.stack(packed) for key, packed in self._packed.items()}
        return masks | {f"{key}.width": np.array(width) for key, width in self._width.items()}


def _rendered[T](
    scene: Reconstruction, camera: CameraTrack, frames: Tensor | None, fill: Fill, made: Callable[[Rendered], T]
) -> Iterator[T]:
    """What is made of some frames at a time through another camera, and of what is known about them."""
    frames = torch.arange(len(scene.camera)) if frames is None else frames
    for window, part in scene.stretches(frames):
        times, poses = frames[part] - window.start, camera.select(part)
        still = _still(window, poses, times, fill) if poses.is_static else None
        some = functools.partial(_some_made, made, window, poses, times, fill, still)
        on_cpu = window.scene.device.type == "cpu"
        size = min(BATCH, max(1, PIXELS_AT_ONCE // (camera.width * camera.height))) if on_cpu else GPU_BATCH
        batches = [slice(start, min(start + size, len(times))) for start in range(0, len(times), size)]
        yield from each_on(window.scene.device, some, batches)


def _some_made[T](
    made: Callable[[Rendered], T],
    window: FittedWindow,
    camera: CameraTrack,
    times: Int[Tensor, " every"],
    fill: Fill,
    still: _Still | None,
    batch: slice,
) -> T:
    """What is made of a batch of a window's frames."""
    poses = camera.select(batch)
    every = window.evidence.moving_frames
    view = None if still is None else still.view
    rendering = next(render_frames(window.scene, poses, times[batch], batch=len(poses), extra=every, still=view))
    if fill == "none":
        behind = rendering.rgb.new_zeros(1, 1, 1, 3)
    elif still is None or still.filling is None:
        behind = torch.stack([_filled(rendering, i, fill) for i in range(len(rendering.alpha))])
    else:
        behind = still.filling * _brightness(window.scene, times[batch], times)
    looked_up = None if still is None else still.looked
    return made((rendering, coverage_of(rendering, poses, window.evidence, looked_up), behind))


@torch.no_grad()
def _still(window: FittedWindow, camera: CameraTrack, times: Tensor, fill: Fill) -> _Still:
    """What a fixed camera sees of what stands still, in the middle of its frames."""
    middle = [len(times) // 2]
    pose = camera.select(middle)
    view = window.scene.still_before(pose)
    rendering = next(render_frames(window.scene.still(), pose, times[middle], still=view))
    filling = None if fill == "none" else _filled(rendering, 0, fill)[None]
    return _Still(view, filling, looked(rendering.depth[0], to_device(pose, rendering.depth.device), window.evidence))


def _filled(rendering: Rendering, i: int, fill: Fill) -> Float[Tensor, "h w 3"]:
    """One frame of a rendering with its holes filled, on the rendering's device."""
    picture = to_device((rendering.rgb[i], rendering.alpha[i], rendering.depth[i]), "cpu")
    return filled(*picture, fill).to(rendering.rgb.device)


def _brightness(scene: DynamicScene, times: Tensor, all_times: Tensor) -> Float[Tensor, "t 1 1 1"] | float:
    """Mean brightness of the background at some times, relative to the middle one."""
    if scene.shading is None:
        return 1.0
    middle = all_times[len(all_times) // 2]
    gains = scene.shading.static_gain(torch.cat((middle[None], times))).mean(1)
    return (gains[1:] / gains[0])[:, None, None, None]
