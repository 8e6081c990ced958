"""What several episodes of one fixed camera show together: what the arm hides in one is taken from another."""

import logging
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.sampling import evenly, scaled_px, scaled_window
from lerobot_msdyn.core.serialise import from_named_tensors, named_tensors
from lerobot_msdyn.priors.camera.stands import is_displaced
from lerobot_msdyn.priors.depth.flying_pixels import clean_recorded_depth
from lerobot_msdyn.priors.masks.moving import median_picture
from lerobot_msdyn.reconstruction.background import MARGIN_PX, SAMPLES, EmptyScene, empty_scene
from lerobot_msdyn.scene.gaussians import Gaussians, rgb_to_sh

logger = logging.getLogger(__name__)

MAX_EPISODES = 8  # that are looked at
FRAMES_EACH = 20
MAX_SHIFT_PX = 1.0  # of 320, of a camera between episodes that still count as seen by the same
SURE_FRAMES = 3  # in which a pixel of the pooled episodes must be seen to count
WEAK_SHARE = 0.25  # of the frames; seen in fewer, a pixel of an episode's empty scene yields to the others
ALIKE_GREY_LEVELS = 12.0  # difference up to which two pictures show the same
ALIKE_DEPTH = 0.02  # relative difference up to which depths are of one surface
AFFINE_ROUNDS = 3

# (numbers of views, frames of all views beside them) -> what moves in each, 0 = nothing
MovingIn = Callable[[Sequence[int], UInt8[Tensor, "m h w 3"]], Iterable[UInt8[Tensor, "t h w"]]]


@dataclass(frozen=True)
class SharedBackground:
    """The empty scene of one camera, as its episodes show it together."""

    empty: EmptyScene
    camera: CameraTrack  # of one frame
    frames: UInt8[Tensor, "m h w 3"]  # those of all episodes that were looked at
    static: Gaussians | None = None  # fitted to it, a Gaussian per pixel of the grid of `background_gaussians`

    def fits(self, view: View) -> bool:
        """Whether a video was taken by this camera, at this size, from this place."""
        camera = view.camera
        if not camera.is_static or (camera.width, camera.height) != (self.camera.width, self.camera.height):
            return False
        same = torch.equal(camera.intrinsics[0], self.camera.intrinsics[0]) and torch.equal(
            camera.world_from_camera[0], self.camera.world_from_camera[0]
        )
        picture = median_picture(view.rgb[few(len(view.rgb))])
        return same and from_one_place(picture, self.empty.rgb)


def same_places(views: list[View]) -> list[list[int]]:
    """Numbers of the videos that were taken from the same place, a list for each; those that are alone are left out.

    Videos of moving cameras are left out as well.
    """
    groups: list[list[int]] = []
    pictures: list[UInt8[Tensor, "h w 3"]] = []
    for number, view in enumerate(views):
        if not view.camera.is_static:
            continue
        picture = median_picture(view.rgb)
        near = [i for i, other in enumerate(pictures) if from_one_place(picture, other)]
        if near:
            groups[min(near, key=lambda i: shift_px(picture.numpy(), pictures[i].numpy()))].append(number)
        else:
            groups.append([number])
            pictures.append(picture)
    return [group for group in groups if len(group) > 1]


def pooled(views: list[View], numbers: list[int], moving: MovingIn) -> SharedBackground:
    """What some frames of several videos from one place show together.

    `moving` is asked what moves in the frames of the views, by their numbers, and given the frames of all of them.
    """
    frames = torch.cat([view.rgb for view in views])
    depths: list[Float[Tensor, "t h w"]] = []
    for view in views:
        unknown = torch.zeros(view.rgb.shape[:3])
        depths.append(unknown if view.depth is None else clean_recorded_depth(view.depth, *view.depth_range))
    instances = torch.cat(list(moving(numbers, frames)))
    return SharedBackground(empty_scene(frames, torch.cat(depths), instances), views[0].camera.select([0]), frames)


def completed(own: EmptyScene, shared: EmptyScene, frames: int) -> EmptyScene:
    """An episode's empty scene, with what it hardly shows taken from the shared one, in the episode's own colours.

    What it never shows, and what it shows otherwise but in few of its `frames`: there the masks are more often wrong.
    """
    colours = colour_match(shared, own).applied(shared.rgb)
    weak = own.seen < WEAK_SHARE * min(frames, SAMPLES)
    take = (shared.seen >= SURE_FRAMES) & ((own.seen == 0) | (weak & _differs(colours, shared, own)))
    if not bool(take.any()):
        return own
    logger.info("%.1f %% of the background taken from other episodes", 100 * float(take.float().mean()))
    return EmptyScene(
        torch.where(take[..., None], colours, own.rgb),
        torch.where(take & (shared.depth > 0), shared.depth, own.depth),
        torch.where(take, shared.seen, own.seen),
    )


def _differs(colours: UInt8[Tensor, "h w 3"], shared: EmptyScene, own: EmptyScene) -> Bool[Tensor, "h w"]:
    """Where a shared empty scene, in an episode's `colours`, shows another surface than the episode's."""
    colour = (colours.int() - own.rgb.int()).abs().amax(-1) > ALIKE_GREY_LEVELS
    depth = (shared.depth - own.depth).abs() > ALIKE_DEPTH * own.depth
    return colour | (depth & (own.depth > 0) & (shared.depth > 0))


def adapted(shared: SharedBackground, own: EmptyScene, fresh: Gaussians) -> Gaussians:
    """The shared static set in an episode's colours, and with its own Gaussians where its empty scene is another.

    Args:
        shared: with a fitted set.
        own: the episode's empty scene, completed.
        fresh: the set that `background_gaussians` makes of it, of the same size.
    """
    assert shared.static is not None
    match = colour_match(shared.empty, own)
    differs = differing(shared.empty, own)
    logger.info("%.1f %% of the shared background is another in this episode", 100 * float(differs.float().mean()))
    rgb = shared.static.rgb * match.factor + match.offset / 255
    return exchanged(replace(shared.static, sh=rgb_to_sh(rgb)), fresh, differs)


def differing(shared: EmptyScene, own: EmptyScene) -> Bool[Tensor, "h w"]:
    """Where an episode's empty scene is another than the shared one, beyond exposure, or the shared one is unknown."""
    mine = (shared.seen < SURE_FRAMES) | ((own.depth > 0) & (shared.depth == 0))
    mine |= _differs(colour_match(shared, own).applied(shared.rgb), shared, own)
    return torch.from_numpy(cv2.dilate(mine.numpy().astype(np.uint8), scaled_window(MARGIN_PX, mine.shape[1])) > 0)


def continued(first: EmptyScene, own: EmptyScene, differs: Bool[Tensor, "h w"]) -> EmptyScene:
    """The empty scene of a video's first window, but what a later one shows where it differs."""
    return EmptyScene(
        torch.where(differs[..., None], own.rgb, first.rgb),
        torch.where(differs, own.depth, first.depth),
        torch.where(differs, own.seen, first.seen),
    )


def exchanged(gaussians: Gaussians, others: Gaussians, where: Bool[Tensor, "h w"]) -> Gaussians:
    """A Gaussian per pixel of the grid of `background_gaussians`, with others in its place at some pixels.

    Raises:
        ValueError: there are as many as in another grid.
    """
    grid = round(math.sqrt(where.numel() / len(others)))
    rows = where[grid // 2 :: grid, grid // 2 :: grid].reshape(-1).to(others.means.device)
    if not len(rows) == len(gaussians) == len(others):
        raise ValueError(f"{len(gaussians)} and {len(others)} Gaussians; expected {len(rows)} of each")
    return Gaussians(
        **{
            name: torch.where(rows.reshape(-1, *[1] * (tensor.dim() - 1)), tensor, getattr(gaussians, name))
            for name, tensor in vars(others).items()
        }
    )


@dataclass(frozen=True)
class ColourMatch:
    """Exposure and white balance: per channel a factor and an offset (grey levels)."""

    factor: Float[Tensor, "3"]
    offset: Float[Tensor, "3"]

    def applied(self, picture: UInt8[Tensor, "h w 3"]) -> UInt8[Tensor, "h w 3"]:
        """A picture in the other's colours."""
        return (picture.float() * self.factor + self.offset).round().clamp(0, 255).to(torch.uint8)


def colour_match(shared: EmptyScene, own: EmptyScene) -> ColourMatch:
    """What gives the shared picture the colours of an episode's, robustly: things that differ do not count."""
    usable = ((own.seen > 0) & (shared.seen > 0)).numpy()
    lines = np.tile(np.array([1.0, 0.0], np.float32), (3, 1))  # factor and offset of each channel
    for channel, line in enumerate(lines):
        x, y = (scene.rgb.numpy()[usable, channel].astype(np.float64) for scene in (shared, own))
        line[1] = np.median(y - x) if len(x) else 0.0
        for _ in range(AFFINE_ROUNDS):
            alike = np.abs(line[0] * x + line[1] - y) < ALIKE_GREY_LEVELS
            if alike.sum() < 2 or np.ptp(x[alike]) == 0:
                break
            line[:] = np.polyfit(x[alike], y[alike], 1)
    return ColourMatch(torch.from_numpy(lines[:, 0].copy()), torch.from_numpy(lines[:, 1].copy()))


def from_one_place(picture: UInt8[Tensor, "h w 3"], other: UInt8[Tensor, "i j 3"]) -> bool:
    """Whether two pictures were taken from the same place: by phase correlation, and by their corners where these tell.

    What is the same in all pictures, such as black bars, can hide a shift from the first.
    """
    if shift_px(picture.numpy(), other.numpy()) >= scaled_px(MAX_SHIFT_PX, picture.shape[1]):
        return False
    return not is_displaced(picture, other)


def shift_px(picture: UInt8[ndarray, "h w 3"], other: UInt8[ndarray, "i j 3"]) -> float:
    """By how much one picture is shifted against another (phase correlation); different sizes: infinitely."""
    if picture.shape != other.shape:
        return float("inf")
    first, second = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in (picture, other))
    window = cv2.createHanningWindow(first.shape[::-1], cv2.CV_32F)
    (dx, dy), _ = cv2.phaseCorrelate(first, second, window)
    return float(np.hypot(dx, dy))


def as_arrays(background: SharedBackground) -> dict[str, ndarray]:
    """A background for a file, without its frames and camera."""
    tensors = named_tensors(background.empty) | named_tensors(background.static, "static")
    return {name: tensor.numpy() for name, tensor in tensors.items()}


def from_arrays(arrays: dict[str, ndarray], camera: CameraTrack, frames: UInt8[Tensor, "m h w 3"]) -> SharedBackground:
    """What `as_arrays` gave, with its frames and camera."""
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    empty = from_named_tensors(EmptyScene, tensors)
    static = from_named_tensors(Gaussians, tensors, "static") if "static.means" in tensors else None
    return SharedBackground(empty, camera, frames, static)


def few(frames: int) -> list[int]:
    """Evenly spread frames of a video of so many."""
    return evenly(frames, FRAMES_EACH).tolist()
