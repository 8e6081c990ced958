"""What is known about a video before the fit: depth, what moves, and point tracks, by the configured providers."""

import logging
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lerobot_msdyn.config import CameraConfig, PriorsConfig
from lerobot_msdyn.episode import View
from lerobot_msdyn.errors import PriorError
from lerobot_msdyn.priors.depth import align_disparity, clean_recorded_depth, table_plane_depth
from lerobot_msdyn.priors.masks import empty_scene, moving_instances, temporal_median
from lerobot_msdyn.priors.tracks import flow_tracks
from lerobot_msdyn.priors.types import PointTracks, Priors

__all__ = ["PointTracks", "Priors", "estimate_priors"]

logger = logging.getLogger(__name__)


def estimate_priors(view: View, config: PriorsConfig, camera: CameraConfig) -> Priors:
    """Run the providers that the recipe asks for on one camera's video.

    Raises:
        PriorError: depth was demanded (`recorded`, or a file) and cannot be had.
    """
    median, noise = temporal_median(view.rgb)
    instances = moving_instances(view.rgb, median, noise)
    depth, metric, why = _depth(view, instances, config.depth, camera)
    empty = empty_scene(view.rgb, instances, median)
    tracks = flow_tracks(view.rgb, instances)
    found = int(instances.max())
    provenance = {
        "depth": why,
        "masks": f"difference to the temporal median of {len(view.rgb)} frames, {found} moving instances",
        "tracks": f"chained dense optical flow (DIS), {len(tracks)} tracks",
    }
    for prior, line in provenance.items():
        logger.info("%s: %s", prior, line)
    return Priors(depth, instances, empty, tracks, metric, provenance)


def _depth(
    view: View, instances: UInt8[Tensor, "t h w"], provider: str, camera: CameraConfig
) -> tuple[Float[Tensor, "t h w"], bool, str]:
    """Depth (m, 0 = unknown), whether it is metric, and one line that says where it comes from."""
    if provider == "recorded" and view.depth is None:
        raise PriorError("priors.depth is 'recorded', but the dataset has no <camera>_depth feature; use auto or plane")
    if provider in ("auto", "recorded") and view.depth is not None:
        return clean_recorded_depth(view.depth, *view.depth_range), True, "recorded by the dataset"
    plane = table_plane_depth(instances, view.camera.intrinsics[0], camera.height_m, camera.tilt_deg)
    if provider in ("auto", "plane"):
        why = f"a table plane seen from {camera.height_m:g} m at {camera.tilt_deg:g} degrees, since none is recorded"
        return plane, False, why
    return _exchange_depth(Path(provider), plane)


def _exchange_depth(path: Path, plane: Float[Tensor, "t h w"]) -> tuple[Float[Tensor, "t h w"], bool, str]:
    """Depth of an exchange file: `depth` [t,h,w] and `depth_kind` metric or affine_disparity (docs/priors.md)."""
    try:
        with np.load(path, allow_pickle=False) as file:
            values = torch.from_numpy(file["depth"].astype(np.float32))
            kind = str(file["depth_kind"]) if "depth_kind" in file else "metric"
    except (OSError, ValueError, KeyError) as error:
        raise PriorError(f"priors.depth: {path} has no readable `depth` array ({error}); see docs/priors.md") from error
    if len(values) != len(plane):
        raise PriorError(f"priors.depth: {path} has {len(values)} frames; the episode has {len(plane)}")
    values = torch.nn.functional.interpolate(values[:, None], plane.shape[1:], mode="nearest-exact")[:, 0]
    if kind == "metric":
        return clean_recorded_depth(values, 0.0, float("inf")), True, f"{path.name} (metric)"
    if kind == "affine_disparity":
        return align_disparity(values, plane), False, f"{path.name} (disparity, scaled to the table plane)"
    raise PriorError(f"priors.depth: {path} has depth_kind {kind!r}; expected metric or affine_disparity")
