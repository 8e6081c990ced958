"""What the recorded camera shows and the scene does not explain is shown as it was recorded, frame by frame."""

import logging
import math
from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.sampling import scaled_px
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.core.visibility import projected
from lerobot_msdyn.priors import Priors
from lerobot_msdyn.reconstruction.background import fill_depth, pixel_gaussians
from lerobot_msdyn.render.cpu.threads import in_threads
from lerobot_msdyn.scene.dynamic import DynamicScene, Snapshot, patched
from lerobot_msdyn.scene.footprints import footprints
from lerobot_msdyn.scene.overlay import FramePatch, Overlay, packed
from lerobot_msdyn.scene.rendering import Rendering, render_scene, render_snapshot

logger = logging.getLogger(__name__)

COLOUR_ERROR = 0.06  # mean absolute difference of colours 0..1, over about a pixel, beyond which one is not explained
DEPTH_ERROR = 0.02  # relative difference of depths beyond which it is not, at least
NEVER = 1e6  # a relative difference of depths that there is not
JUMP = 0.05  # relative step of depth to the surface in front, beyond which a pixel belongs to the one behind
THICKNESS = 0.03  # share of the depth within which a Gaussian belongs to the recorded surface
SCALE = 0.7  # of a pixel's Gaussian: its neighbours are rendered as well
ERROR_AROUND = 0.04  # the same over several pixels of the moving set, all of which it then condemns
_SMOOTH_PX, _AROUND_PX = 1.0, 8.0  # standard deviations of these averages, at a width of 320
_BESIDE = np.ones((3, 3), np.uint8)  # a pixel and those beside it


def unexplained(scene: DynamicScene, view: View, priors: Priors, backend: str = "auto") -> Overlay:
    """The patches of all frames that make the recorded camera see what it recorded (docs/reconstruction.md, "Overlay").

    A pixel is unexplained where the rendered picture has another colour or depth than the recorded one. There the
    frame's own pixels are put at their recorded depth, for this frame alone, and Gaussians of the scene in front of
    that surface or on it are not rendered. What lies behind it stays, and is seen past its edges from other cameras.
    Depth only contradicts the scene beyond what its provider may err by, and not at all where it is assumed.

    Args:
        scene: fitted, without an overlay; on any device, the result is on the host.
        view: the video, at the size at which it was fitted.
        priors: its depth.
        backend: of the rasterizer.
    """
    tolerance = depth_tolerance(priors)

    def still_depth(frame: int) -> Float[Tensor, "h w"]:
        shown = render_scene(scene.still(), view.camera.select([frame]), torch.tensor([frame]), backend)
        return shown.depth[0].cpu()

    always = still_depth(0) if view.camera.is_static else None

    def patch_of(frame: int) -> FramePatch:
        depth, still = fill_depth(priors.depth[frame]), still_depth(frame) if always is None else always
        camera, when = to_device((view.camera.select([frame]), torch.tensor([frame])), scene.device)
        snapshot = scene.at(when, camera.world_from_camera[:, :3, 3])
        rendering = to_device(render_snapshot(snapshot, camera, scene.near, backend), "cpu")
        wrong = _wrong(rendering, view.rgb[frame].float() / 255, depth.numpy(), tolerance)
        taken = wrong & ~_behind_an_edge(depth.numpy(), still.numpy())
        return _patch(snapshot, view, depth, frame, wrong, taken, scene.near, backend)

    frames = range(len(view.rgb))
    overlay = packed([*(in_threads(patch_of, frames) if scene.device.type == "cpu" else map(patch_of, frames))])
    percent = 100 * len(overlay.means) / max(priors.depth.numel(), 1)
    logger.info("overlay: %.1f %% of all pixels are not explained and shown as recorded", percent)
    return overlay


def depth_tolerance(priors: Priors) -> float:
    """Relative difference of depths beyond which a picture is wrong; beyond all for depth that is only assumed."""
    traits = priors.depth_traits
    return NEVER if traits.assumed else max(DEPTH_ERROR, traits.relative_error)


def _wrong(
    rendering: Rendering, recorded: Float[Tensor, "h w 3"], depth: Float[ndarray, "h w"], tolerance: float
) -> Bool[ndarray, "h w"]:
    """Where a rendered picture has another colour or depth (m) than the recorded one, and the pixels beside."""
    difference = (rendering.rgb[0].clamp(0, 1) - recorded).abs().mean(-1).numpy()
    rendered = rendering.depth[0].numpy()
    moving = (rendering.moving[0] > 0.5).numpy()
    smooth_px, around_px = (scaled_px(px, depth.shape[1]) for px in (_SMOOTH_PX, _AROUND_PX))
    around = _blurred(difference * moving, around_px) > ERROR_AROUND * _blurred(moving, around_px)
    wrong = (_blurred(difference, smooth_px) > COLOUR_ERROR) | (np.abs(rendered / depth - 1) > tolerance)
    wrong |= moving & around
    # Behind an edge colours are mixed, and say nothing; there only the depth of no pixel beside counts as wrong.
    nearest, farthest = (1 - tolerance) * cv2.erode(rendered, _BESIDE), (1 + tolerance) * cv2.dilate(rendered, _BESIDE)
    wrong = np.where(_behind(depth), (depth < nearest) | (depth > farthest), wrong)
    opened = cv2.morphologyEx(wrong.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    return cv2.dilate(opened, _BESIDE) > 0


def _blurred(image: Float[ndarray, "h w"] | Bool[ndarray, "h w"], sigma_px: float) -> Float[ndarray, "h w"]:
    return cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma_px)


def _behind(depth: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Pixels beside a nearer surface."""
    return depth > (1 + JUMP) * cv2.erode(depth, _BESIDE)


def _behind_an_edge(depth: Float[ndarray, "h w"], still: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Pixels beside a nearer surface, whose colours mix with its own, that float or that the static set shows."""
    behind = _behind(depth)
    floating = behind & ((1 + JUMP) * depth < cv2.dilate(depth, _BESIDE))
    return floating | (behind & (np.abs(still / depth - 1) < DEPTH_ERROR))


def _patch(
    snapshot: Snapshot,
    view: View,
    depth: Float[Tensor, "h w"],
    frame: int,
    wrong: Bool[ndarray, "h w"],
    taken: Bool[ndarray, "h w"],
    near: float,
    backend: str,
) -> FramePatch:
    """The pixels that are taken as Gaussians, with colours that make the rendered picture the recorded one.

    What a pixel's Gaussian lacks of the recorded colour is added to its own, by no more than the contrast to the pixels
    beside, which are what mixes with it. More is lacking where something else is seen through, as at the picture's
    border: from another camera, that would be a bright line.
    """
    camera, picture, chosen = view.camera.select([frame]), view.rgb[frame], torch.from_numpy(taken)
    pixels = pixel_gaussians(picture, depth, view.camera, frame, where=chosen)[0]
    hidden = _hidden(to_device(snapshot, "cpu"), camera, depth, torch.from_numpy(wrong), chosen)
    log_scales, recorded = pixels.log_scales + math.log(SCALE), picture[chosen].float() / 255
    first = FramePatch(pixels.means, pixels.quats, log_scales, recorded, hidden)
    if len(first) == 0:
        return first
    camera = to_device(camera, snapshot.means.device)
    beside = footprints(snapshot.means[0], snapshot.scales.amax(-1), camera).may_cover(taken)  # all that these show
    alone = to_device(replace(first, hidden=hidden | ~beside.cpu()), snapshot.means.device)
    rendered = render_snapshot(patched(snapshot, alone), camera, near, backend).rgb[0].cpu()[chosen]
    most = _contrast(picture)[chosen]
    lacking = (recorded - rendered).clamp(-most, most)
    return replace(first, rgb=(recorded + lacking).clamp(0, 1.5))


def _contrast(rgb: UInt8[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """The range of each colour over a pixel and those beside, 0..1."""
    picture = rgb.numpy()
    return torch.from_numpy(cv2.dilate(picture, _BESIDE) - cv2.erode(picture, _BESIDE)).float() / 255


def _hidden(
    snapshot: Snapshot,
    camera: CameraTrack,
    depth: Float[Tensor, "h w"],
    wrong: Bool[Tensor, "h w"],
    taken: Bool[Tensor, "h w"],
) -> Bool[Tensor, " g"]:
    """Gaussians on or before the recorded surface: moving ones where it is wrong, static ones where it is replaced."""
    seen = projected(snapshot.means[0], camera)
    replaced = torch.where(snapshot.moving > 0, wrong[seen.pixel], taken[seen.pixel])
    return replaced & seen.visible(depth, THICKNESS)
