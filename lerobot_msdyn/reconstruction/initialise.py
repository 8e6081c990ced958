"""From priors to a scene: a static set from the empty scene, and a moving set gathered from several frames."""

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.config import MotionConfig, SceneConfig
from lerobot_msdyn.core.geometry import quaternion_conjugate, quaternion_multiply
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.sampling import evenly, scaled_window
from lerobot_msdyn.core.visibility import projected
from lerobot_msdyn.motion.estimate import SceneMotion, scene_motion
from lerobot_msdyn.motion.to_video.register import Recording
from lerobot_msdyn.priors import Priors
from lerobot_msdyn.reconstruction.background import fill_depth, pixel_gaussians
from lerobot_msdyn.reconstruction.key_views import KeyView, key_views, static_gaussians
from lerobot_msdyn.render.cpu.threads import in_threads
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import Gaussians, concatenate, isotropic

MASK_BORDER_PX = 2  # of 320: so far from a mask its border cannot be trusted
FRONT_MARGIN = 0.01  # a point nearer than this share of the recorded depth is in front of it
MAX_CONTRADICTIONS = 0.3  # share of frames in which a point may be missing where it should have been seen
VOXEL_GROWTH = 1.15  # of the voxels' side, until there are few enough
ROUGH_BORDER_PX = 2  # of 320; with depth that is not sharp: from the border of a mask ...
ROUGH_FRAMES = 6  # ... and so few frames are gathered, whose depths disagree; known bodies aside
EDGE_JUMP = 0.03  # relative difference of neighbouring depths beyond which a pixel may lie between two surfaces


def initialise(
    view: View, priors: Priors, scene: SceneConfig, motion: MotionConfig, keys: Sequence[KeyView] = ()
) -> DynamicScene:
    """A scene ready to be fitted.

    Args:
        view: the video, at the size at which it is fitted.
        priors: its priors, at the same size.
        scene: numbers of Gaussians.
        motion: the levels of motion.
        keys: what stands still; default: as this video shows it.
    """
    static = static_gaussians(keys or key_views(view, priors), scene.static_gaussians)
    estimated = _motion(view, priors, motion) if scene.moving_gaussians > 0 else None
    if estimated is None:
        moving = static.select(torch.zeros(0, dtype=torch.long))
        return DynamicScene(static, moving, (), (), (), len(view.rgb))
    moving, part = gather_moving(view, priors, estimated, scene)
    if scene.isotropic:
        static, moving = isotropic(static), isotropic(moving)
    bindings = estimated.bind(moving.means, part)
    canonical = estimated.canonical_frame
    return DynamicScene(static, moving, estimated.levels, *bindings, len(view.rgb), canonical_frame=canonical)


def _motion(view: View, priors: Priors, config: MotionConfig) -> SceneMotion | None:
    """Motion of everything that was tracked, by what was recorded too where depth is true."""
    wanted = config.register and priors.metric
    recording = Recording.of(view.rgb, priors.depth, priors.instances, view.camera) if wanted else None
    return scene_motion(priors.tracks, priors.depth, view.camera, config, recording, priors.bodies)


def gather_moving(
    view: View, priors: Priors, motion: SceneMotion, config: SceneConfig
) -> tuple[Gaussians, Int[Tensor, " n"]]:
    """Gaussians of everything that moves, in the canonical frame, and the part of which each is a piece.

    Moving pixels of evenly spread frames are carried back by the motion of their part and merged in voxels of about a
    pixel's size, so that what one frame hides is taken from another. Larger voxels are used where these are too many.
    """
    frames = evenly(len(view), config.moving_frames).tolist()
    sharp = priors.depth_traits.sharp
    few = frames if sharp else evenly(len(view), min(config.moving_frames, ROUGH_FRAMES)).tolist()
    border_px = config.mask_border_px if sharp else max(config.mask_border_px, ROUGH_BORDER_PX)
    known = 0 if priors.bodies is None else priors.bodies.instance

    def taken(frame: int) -> tuple[Gaussians, Int[Tensor, " n"]] | None:
        depth, instances = priors.depth[frame], priors.instances[frame]
        body = (instances == known) & (instances > 0)
        chosen = torch.zeros_like(body)
        if frame in few:
            chosen |= _certain(instances > 0, depth, border_px) & ~body
        if frame in frames:
            chosen |= _certain(instances > 0, depth, config.mask_border_px) & body
        if not bool(chosen.any()):
            return None
        pixels, _ = pixel_gaussians(view.rgb[frame], fill_depth(depth), view.camera, frame, where=chosen)
        return to_canonical(pixels, motion, frame, instances[chosen].long())

    gathered = [some for some in in_threads(taken, sorted({*frames, *few})) if some is not None]
    if not gathered:
        empty = pixel_gaussians(view.rgb[0], fill_depth(priors.depth[0]), view.camera, 0)[0]
        return empty.select(torch.zeros(0, dtype=torch.long)), torch.zeros(0, dtype=torch.long)
    depth = priors.depth[(priors.instances > 0) & (priors.depth > 0)]
    voxel = config.moving_voxel_px * float(depth.median()) / float(view.camera.intrinsics[0, 0, 0])
    points, part = concatenate([points for points, _ in gathered]), torch.cat([part for _, part in gathered])
    extent = float((points.means.amax(0) - points.means.amin(0)).max())
    growth = 1.0
    merged = merge_voxels(points, part, voxel)
    while len(merged[0]) > config.moving_gaussians and growth * voxel <= extent:
        growth *= VOXEL_GROWTH
        merged = merge_voxels(points, part, growth * voxel)
    moving, part = merged
    kept = ~contradicted(moving.means, part, motion, view, priors, few)
    moving, part = moving.select(kept), part[kept]
    most = slice(config.moving_gaussians)  # one voxel per part may still be too many
    moving, part = moving.select(most), part[most]
    return replace(moving, log_scales=moving.log_scales + math.log(growth)), part


def contradicted(
    points: Float[Tensor, "n 3"],
    part: Int[Tensor, " n"],
    motion: SceneMotion,
    view: View,
    priors: Priors,
    frames: list[int],
) -> Bool[Tensor, " n"]:
    """Canonical points (m) that should have been seen, but were not.

    A point that its part's motion puts in front of the recorded surface, where nothing moves, cannot be there; too
    many such frames among those in which it is inside the image are held against it.
    """

    def seen_at(frame: int) -> tuple[Bool[Tensor, " n"], Bool[Tensor, " n"]]:
        world = motion.moved(points, part, torch.tensor([frame]))[0][0]
        seen = projected(world, view.camera.select([frame]))
        surface = priors.depth[frame][seen.pixel]
        still = _grown(priors.instances[frame] > 0)[seen.pixel].logical_not()
        return still & (surface > 0) & seen.visible(priors.depth[frame], -FRONT_MARGIN), seen.inside

    wrong, inside = torch.zeros(len(points)), torch.zeros(len(points))
    for wrong_now, inside_now in in_threads(seen_at, frames):
        wrong += wrong_now
        inside += inside_now
    return wrong > MAX_CONTRADICTIONS * inside


def to_canonical(
    gaussians: Gaussians, motion: SceneMotion, frame: int, instance: Int[Tensor, " n"]
) -> tuple[Gaussians, Int[Tensor, " n"]]:
    """Gaussians seen at a frame, carried back to the canonical frame by the motion of their part, and that part."""
    means, part = motion.to_canonical(gaussians.means, frame, instance)
    turn = motion.moved(means, part, torch.tensor([frame]))[1][0]
    quats = quaternion_multiply(quaternion_conjugate(turn), gaussians.quats)
    return replace(gaussians, means=means, quats=quats), part


def merge_voxels(gaussians: Gaussians, part: Int[Tensor, " n"], voxel: float) -> tuple[Gaussians, Int[Tensor, " m"]]:
    """One Gaussian per occupied voxel (side in m) and part: mean position and colour, the first one's shape."""
    corner = gaussians.means.amin(0)
    cell = torch.zeros_like(part)
    for index in (*((gaussians.means - corner) / voxel).floor().long().T, part):  # one number each: sorted faster
        values, rank = torch.unique(index, return_inverse=True)
        cell = cell * len(values) + rank
    _, group, count = torch.unique(cell, return_inverse=True, return_counts=True)
    first = torch.full((len(count),), len(group)).scatter_reduce(0, group, torch.arange(len(group)), "amin")

    def mean(values: Float[Tensor, "n *_"]) -> Float[Tensor, "m *_"]:
        total = torch.zeros(len(count), *values.shape[1:]).index_add_(0, group, values)
        return total / count.reshape(-1, *[1] * (values.dim() - 1))

    chosen = gaussians.select(first)
    merged = Gaussians(
        mean(gaussians.means), chosen.quats, chosen.log_scales, chosen.opacity_logits, mean(gaussians.sh)
    )
    return merged, part[first]


def _certain(mask: Bool[Tensor, "h w"], depth: Float[Tensor, "h w"], border_px: int) -> Bool[Tensor, "h w"]:
    """Pixels `border_px` (of a picture 320 wide) inside a mask, of known depth, and as far from depth edges."""
    window = scaled_window(border_px, mask.shape[1])
    inside = cv2.erode(mask.numpy().astype(np.uint8), window, borderType=cv2.BORDER_REPLICATE) > 0
    z = depth.numpy()
    edge = cv2.dilate(z, window) > (1 + EDGE_JUMP) * cv2.erode(z, window)
    return torch.from_numpy(inside & (z > 0) & ~edge)


def _grown(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """A mask with its border, where it cannot be trusted."""
    window = scaled_window(MASK_BORDER_PX, mask.shape[1])
    return torch.from_numpy(cv2.dilate(mask.numpy().astype(np.uint8), window) > 0)
