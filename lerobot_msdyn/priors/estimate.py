"""Priors of one camera's video, by the configured providers."""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import FIXED, CameraConfig, Device, PriorsConfig
from lerobot_msdyn.core.fields import AUTO
from lerobot_msdyn.core.observations import Origin, Priors, View
from lerobot_msdyn.priors.cache import digest_of, open_cache
from lerobot_msdyn.priors.camera.field_of_view import with_searched_fov
from lerobot_msdyn.priors.camera.scale import scaled_to_depth
from lerobot_msdyn.priors.camera.sfm import SFM
from lerobot_msdyn.priors.depth.lying import with_lying
from lerobot_msdyn.priors.from_file import CameraFile, DepthFile, MaskFile, TrackFile
from lerobot_msdyn.priors.masks.moving import instances_before
from lerobot_msdyn.priors.masks.providers.change import CHANGE
from lerobot_msdyn.priors.provide import check_named, provide
from lerobot_msdyn.priors.registry import CameraProvider, Depth, DepthProvider, MaskProvider, Masks, TrackProvider
from lerobot_msdyn.priors.request import Request
from lerobot_msdyn.priors.robot import with_robot, with_robot_depth
from lerobot_msdyn.render.devices import chosen_device

logger = logging.getLogger(__name__)


def estimate_priors(
    view: View,
    config: PriorsConfig,
    camera: CameraConfig,
    *,
    others: Sequence[View] = (),
    elsewhere: UInt8[Tensor, "m h w 3"] | None = None,
    episode: int | None = None,
    key: str | None = None,
    device: Device = "auto",
) -> Priors:
    """Run the providers that the recipe asks for on one camera's video.

    Args:
        view: the video.
        config: the providers.
        camera: what is assumed about the camera.
        others: videos of the same moments by other cameras, for stereo.
        elsewhere: frames of other episodes of the same fixed camera, which show the masks what this one hides.
        episode: index of the episode, by which exchange files are found and checked.
        key: feature key of the camera, likewise.
        device: auto, cpu or cuda, for learned providers.

    Raises:
        ConfigError: there is no such provider, or the device cannot be used.
        PriorError: a provider was asked for by name and cannot be had, or an exchange file cannot be used.
    """
    cache, networks_on = open_cache(config.cache, view.rgb), chosen_device(device, networks=True).type
    request = Request(view, config, camera, cache, others, elsewhere, episode, key, networks_on)
    told = camera.poses not in (AUTO, FIXED) and camera.known_before(key or "")  # by a file: whether it moves as well
    posed = replace(request, view=replace(view, camera=_camera(request)[0])) if told else request
    instances, masks_from = _masks(posed)
    pinhole, camera_from = _camera(request, instances)
    robot = 0
    if view.robot is not None:
        instances, robot = with_robot(instances, view.robot, view.rgb)
    posed = replace(request, view=replace(view, camera=pinhole))
    depth, depth_from = provide(
        DepthProvider, config.depth, posed, lambda provider: provider.estimate(posed, instances), file=DepthFile
    )
    if camera_from.provider == SFM:
        pinhole, factor = scaled_to_depth(pinhole, view.rgb, depth, instances)
        camera_from = replace(camera_from, why=f"{camera_from.why}; shifts times {factor:.4g}, by the depth")
    if masks_from.provider == CHANGE and not pinhole.is_static and not depth.traits.assumed:
        instances = _before_poses(request, pinhole, depth)
        masks_from = replace(masks_from, why=f"{masks_from.why}; by poses and depth")
    tracks, tracks_from = provide(
        TrackProvider, config.tracks, posed, lambda provider: provider.estimate(posed, instances), file=TrackFile
    )
    if pinhole.is_static and depth.traits.metric:  # of a ground that is known: see docs/priors.md
        depth = with_lying(depth, instances, tracks, pinhole, view.robot)
    if view.robot is not None:
        depth = with_robot_depth(depth, instances, view.robot, robot)
    if camera.fov_search:
        pinhole, camera_from = with_searched_fov(pinhole, tracks, depth)
    origins = {"camera": camera_from, "masks": masks_from, "depth": depth_from, "tracks": tracks_from}
    if view.robot is not None:
        origins["robot"] = Origin("calibration", "its links in masks and depth, by the joints", view.robot.model)
    counts = {"masks": f", {int(instances.max())} instances", "tracks": f", {len(tracks)} tracks"}
    for prior, origin in origins.items():
        logger.info("%s: %s%s", prior, origin.line, counts.get(prior, ""))
    provenance = {prior: origin.entry() for prior, origin in origins.items()}
    bodies = replace(view.robot.bodies, instance=robot) if view.robot is not None and robot else None
    return Priors(depth.z, instances, tracks, depth.traits, provenance, pinhole, bodies)


def estimate_masks(
    view: View,
    config: PriorsConfig,
    camera: CameraConfig,
    *,
    elsewhere: UInt8[Tensor, "m h w 3"] | None = None,
    episode: int | None = None,
    key: str | None = None,
    device: Device = "auto",
) -> UInt8[Tensor, "t h w"]:
    """The masks of `estimate_priors` alone (0 = nothing moves), which finds the provider's in the cache afterwards."""
    cache, networks_on = open_cache(config.cache, view.rgb), chosen_device(device, networks=True).type
    instances = _masks(Request(view, config, camera, cache, (), elsewhere, episode, key, networks_on))[0]
    return instances if view.robot is None else with_robot(instances, view.robot, view.rgb)[0]


def known_camera(
    view: View, config: PriorsConfig, camera: CameraConfig, *, episode: int | None = None, key: str | None = None
) -> CameraTrack:
    """The camera of a video by a provider that needs nothing of it (`CameraProvider.known_before`).

    Raises:
        PriorError: it cannot be had.
    """
    return _camera(Request(view, config, camera, open_cache("off", view.rgb), episode=episode, key=key))[0]


def _camera(request: Request, instances: Masks | None = None) -> tuple[CameraTrack, Origin]:
    """The camera, by what moves before it; where that need not be known, it may be left out."""
    masks = torch.zeros(request.view.rgb.shape[:3], dtype=torch.uint8) if instances is None else instances
    return provide(
        CameraProvider,
        request.camera.poses,
        request,
        lambda provider: provider.estimate(request, masks),
        file=CameraFile,
    )


def _before_poses(request: Request, camera: CameraTrack, depth: Depth) -> Masks:
    """What moves before a camera that moves, by its poses and depth."""

    def compute() -> dict[str, np.ndarray]:
        return {"masks": instances_before(request.view.rgb, depth.z, camera).numpy()}

    poses = camera.world_from_camera, camera.intrinsics, depth.z
    settings = {"seen": [digest_of(part.contiguous().view(torch.uint8)) for part in poses]}
    return torch.from_numpy(request.cache.get("masks", "poses", settings, compute)["masks"])


def check_named_providers(config: PriorsConfig, camera: CameraConfig, device: Device = "auto") -> None:
    """Whether the providers that settings name have what they need, before any video is read.

    Raises:
        ConfigError: there is no such provider, or the device cannot be used.
        PriorError: one of them cannot be used.
    """
    networks_on = chosen_device(device, networks=True).type
    check_named(MaskProvider, config.masks, config, networks_on)
    check_named(CameraProvider, camera.poses, config, networks_on)
    check_named(DepthProvider, config.depth, config, networks_on)
    check_named(TrackProvider, config.tracks, config, networks_on)


def _masks(request: Request) -> tuple[Masks, Origin]:
    return provide(
        MaskProvider, request.config.masks, request, lambda provider: provider.estimate(request), file=MaskFile
    )
