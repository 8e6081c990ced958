"""How well a fitted scene explains its own video, at a few frames that the fit never saw: all there is to judge it by.

No ground truth is used. Brightness over time, masks and tracks were measured on these frames as well; the Gaussians
were not fitted to them. New views are rendered with the overlay, which every frame has of itself: so what is wrong with
them is judged with it, and what the scene alone makes of frames that it never saw is told beside.
"""

import functools
import logging
from dataclasses import dataclass

import kornia
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import project, transform_points
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.sampling import evenly, scaled_px
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.priors import Priors
from lerobot_msdyn.reconstruction.account import Account, account_line
from lerobot_msdyn.reconstruction.fast_camera import fast_sharpness, skew_px, speed_px
from lerobot_msdyn.render.cpu.threads import each_on
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.rendering import render_scene
from lerobot_msdyn.scene.sources import Sources, sources_of

logger = logging.getLogger(__name__)

CHECKED_FRAMES = 3  # frames that are looked at where none was held out
STILL_PX = 2  # at a width of 320; so far around a pixel nothing may move for it to stand still
TRACKED = 400  # points, at most, of which the residual is measured
SSIM_WINDOW = 11  # px of any picture, as in the definition: figures of other sizes are not comparable
TRACK_FRAMES = 12  # at which it is measured
DEPTH_FRAMES = 12  # at which the depth of what stands still is compared with itself


@dataclass(frozen=True)
class SelfCheck:
    """A few recorded frames, and what the scene says of them; all at the size at which the scene was fitted."""

    frames: Int[Tensor, " t"]  # of the scene
    held_out: bool  # whether the fit never saw them
    camera: CameraTrack
    recorded: Float[Tensor, "t h w 3"]  # 0..1
    depth: Float[Tensor, "t h w"]  # m, prior; 0 = unknown
    rendered_depth: Float[Tensor, "t h w"]  # m, of the scene with its overlay
    error: Float[Tensor, " t"]  # mean square colour error of the scene with its overlay, 0..1
    fitted_error: Float[Tensor, " t"]  # the same without the overlay
    moving: Bool[Tensor, "t h w"]  # where the masks say that something moves
    account: Account  # what renders these pixels, and how well
    ssim: float  # without the overlay
    track_px: float  # median distance of the tracks to the motion's projection
    flicker: float  # mean absolute difference of what stands still to the next frame, 0..1
    depth_error: float  # relative: what the provider of depth is known for, or more where its depth is less steady
    skew_px: float  # of 320: by how much a rolling shutter bends fast frames of a camera that moves
    fast_sharpness: float  # of its fast frames, relative to its slow ones: low where they are blurred

    @property
    def moving_error(self) -> float:
        """Mean square colour error of what moves by motion alone, 0..1; 0 where nothing does."""
        return self.account.error_by_motion


@torch.no_grad()
def self_check(
    scene: DynamicScene, view: View, priors: Priors, held_out: Int[Tensor, " n"], distance: float
) -> SelfCheck:
    """What a scene, with its overlay, says of frames that it was not fitted to; of others where `held_out` is empty.

    It is on the host. `distance` (m) is that to the look-at point.
    """
    total = len(view.rgb)
    frames = held_out if len(held_out) else evenly(total, CHECKED_FRAMES + 2)
    if len(held_out) == 0 and total > CHECKED_FRAMES + 1:
        frames = frames[1:-1]
    camera = view.camera.select(frames)
    rendering = to_device(render_scene(scene, camera, frames), "cpu")
    recorded = view.rgb[frames].float() / 255
    alone = render_scene(scene.without_patches(), camera, frames).rgb.clamp(0, 1).cpu()
    moving = priors.instances[frames] > 0
    error = (rendering.rgb.clamp(0, 1) - recorded).square().mean(-1)
    error_alone = (alone - recorded).square().mean(-1)
    sources = sources_of(scene, camera, frames)
    account = Account(
        sources.count(moving), _mean_over(error, moving), _mean_over(error_alone, moving), len(held_out) > 0
    )
    logger.info("%s", account_line(account))
    _log_instances(sources, priors.instances[frames])
    speed = speed_px(view.camera, distance)
    skew, fast = skew_px(speed), fast_sharpness(view.rgb, speed)
    if not view.camera.is_static:
        logger.info(
            "camera: goes by %.1f px (of 320) per frame, usually; a rolling shutter would bend fast frames by %.1f px, "
            "whose sharpness is %.2f of the slow ones'",
            float(speed.median()),
            skew,
            fast,
        )
    following = (frames + 1).clamp(max=total - 1)
    still = stands_still(moving) & stands_still(priors.instances[following] > 0)
    traits = priors.depth_traits
    return SelfCheck(
        frames,
        len(held_out) > 0,
        camera,
        recorded,
        priors.depth[frames],
        rendering.depth,
        error.mean((1, 2)),
        error_alone.mean((1, 2)),
        moving,
        account,
        similarity(alone, recorded),
        _track_residual(scene, view.camera, priors),
        flicker(recorded, view.rgb[following].float() / 255, still),
        max(traits.relative_error, traits.still_error, unsteadiness(priors) if view.camera.is_static else 0.0),
        skew,
        fast,
    )


def _log_instances(sources: Sources, instances: UInt8[Tensor, "t h w"]) -> None:
    """Who renders each instance: a large one that seldom moves would hide a small one that always does."""
    ids = [number for number in instances.unique().tolist() if number > 0]
    if len(ids) > 1:
        shares = {number: sources.count(instances == number).shares["by_motion"] for number in ids}
        each = ", ".join(f"instance {number} {100 * share:.0f} %" for number, share in shares.items())
        logger.info("rendered by motion: %s", each)


def _mean_over(error: Float[Tensor, "t h w"], moving: Bool[Tensor, "t h w"]) -> float:
    return float(error[moving].mean()) if bool(moving.any()) else 0.0


def unsteadiness(priors: Priors) -> float:
    """Relative standard deviation over time of the depth of what stands still before a fixed camera, at half of it.

    It has one depth, so that this is what its provider errs by at least; errors that stay do not show.
    """
    frames = evenly(len(priors.depth), DEPTH_FRAMES)
    depth = priors.depth[frames]
    counted = (depth > 0) & (priors.instances[frames] == 0)
    count = counted.sum(0)
    logarithm = depth.clamp(min=1e-6).log() * counted
    mean = logarithm.sum(0) / count.clamp(min=1)
    variance = ((logarithm - mean) * counted).square().sum(0) / count.clamp(min=1)
    often = count > len(frames) / 2
    return float(variance[often].sqrt().median()) if bool(often.any()) else 0.0


def similarity(one: Float[Tensor, "t h w 3"], other: Float[Tensor, "t h w 3"]) -> float:
    """Mean structural similarity (SSIM, Wang et al. 2004)."""
    images = (value.permute(0, 3, 1, 2) for value in (one, other))
    return float(kornia.metrics.ssim(*images, window_size=SSIM_WINDOW).mean())


def stands_still(moving: Bool[Tensor, "t h w"]) -> Bool[Tensor, "t h w"]:
    """Pixels around which nothing moves."""
    reach = max(1, round(scaled_px(STILL_PX, moving.shape[2])))
    return torch.nn.functional.max_pool2d(moving.float(), 2 * reach + 1, 1, reach) == 0


def flicker(
    pictures: Float[Tensor, "t h w 3"], following: Float[Tensor, "t h w 3"], still: Bool[Tensor, "t h w"]
) -> float:
    """Mean absolute difference of what stands still to the next frame; 0 where nothing does."""
    return float((pictures - following).abs().mean(-1)[still].mean()) if bool(still.any()) else 0.0


def _track_residual(scene: DynamicScene, camera: CameraTrack, priors: Priors) -> float:
    """Median distance (px) from where a tracked point is seen to where the motion carries it.

    A point is carried as the Gaussian is that is rendered nearest to it where it was first seen.
    """
    tracks = priors.tracks
    if len(tracks) == 0 or len(scene.moving) == 0:
        return 0.0
    measured = evenly(len(tracks), TRACKED)
    visible, xy = tracks.visible[measured], tracks.xy[measured]
    first = visible.long().argmax(1)
    times = evenly(scene.frames, TRACK_FRAMES)
    needed = sorted({*times.tolist(), *first.tolist()})
    projections = each_on(scene.device, functools.partial(_projected, scene, camera), needed)
    gaussians = dict(zip(needed, projections, strict=True))
    distances = []
    for point in range(len(measured)):
        start = int(first[point])
        offset = gaussians[start] - xy[point, start]
        nearest = offset.square().sum(-1).argmin()
        for time in times[visible[point, times]].tolist():
            distances.append((gaussians[time][nearest] - offset[nearest] - xy[point, time]).norm())
    return float(torch.stack(distances).median()) if distances else 0.0


def _projected(scene: DynamicScene, camera: CameraTrack, time: int) -> Float[Tensor, "m 2"]:
    """Where the moving Gaussians are in the picture (px) at a frame."""
    means = scene.positions(torch.tensor([time]))[0, len(scene.static) :].cpu()
    return project(transform_points(camera.camera_from_world[time], means), camera.intrinsics[time])[0]
