"""Priors of one camera's video, by the configured providers."""

import logging
from collections.abc import Sequence

from jaxtyping import UInt8
from torch import Tensor

from lerobot_msdyn.core.config import CameraConfig, PriorsConfig
from lerobot_msdyn.core.observations import Priors, View
from lerobot_msdyn.priors.cache import open_cache
from lerobot_msdyn.priors.camera.provide import provide_camera, with_searched_fov
from lerobot_msdyn.priors.depth.provide import provide_depth
from lerobot_msdyn.priors.hub import torch_device
from lerobot_msdyn.priors.masks.provide import provide_masks
from lerobot_msdyn.priors.request import Request
from lerobot_msdyn.priors.tracks.provide import provide_tracks

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
    device: str = "auto",
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
        PriorError: a provider was asked for by name and cannot be had, or an exchange file cannot be used.
    """
    cache = open_cache(config.cache, view.rgb)
    request = Request(view, config, camera, cache, others, elsewhere, episode, key, torch_device(device))
    instances, masks_from = provide_masks(request)
    request, camera_from = provide_camera(request, instances)
    (depth, traits), depth_from = provide_depth(request, instances)
    tracks, tracks_from = provide_tracks(request, instances)
    pinhole = request.view.camera
    if camera.fov_search:
        pinhole, camera_from = with_searched_fov(pinhole, tracks, depth, traits)
    origins = {"camera": camera_from, "masks": masks_from, "depth": depth_from, "tracks": tracks_from}
    found = {"masks": f", {int(instances.max())} instances", "tracks": f", {len(tracks)} tracks"}
    for prior, origin in origins.items():
        logger.info("%s: %s%s", prior, origin.line, found.get(prior, ""))
    provenance = {prior: origin.entry() for prior, origin in origins.items()}
    return Priors(depth, instances, tracks, traits, provenance, pinhole)


def estimate_masks(
    view: View,
    config: PriorsConfig,
    camera: CameraConfig,
    *,
    elsewhere: UInt8[Tensor, "m h w 3"] | None = None,
    episode: int | None = None,
    key: str | None = None,
    device: str = "auto",
) -> UInt8[Tensor, "t h w"]:
    """The masks of `estimate_priors` alone (0 = nothing moves), which finds them in the cache afterwards."""
    cache = open_cache(config.cache, view.rgb)
    return provide_masks(Request(view, config, camera, cache, (), elsewhere, episode, key, torch_device(device)))[0]
