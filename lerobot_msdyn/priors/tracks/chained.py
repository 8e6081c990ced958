"""Tracks by chained optical flow, from any network or none, computed once."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from lerobot_msdyn.core.observations import PointTracks
from lerobot_msdyn.priors.cache import digest_of
from lerobot_msdyn.priors.registry import Masks
from lerobot_msdyn.priors.request import Request
from lerobot_msdyn.priors.tracks.flow import PairFlow, flow_tracks


def chained_tracks(
    request: Request, instances: Masks, name: str, settings: dict[str, Any], load: Callable[[], PairFlow | None]
) -> PointTracks:
    """Tracks from the cache, else by `flow_tracks`.

    Args:
        request: the video.
        instances: what moves.
        name: of the flow, for the cache.
        settings: what the flow depends on, besides its name.
        load: makes the flow, where the tracks are not in the cache; None stands for DIS.
    """

    def compute() -> dict[str, np.ndarray]:
        tracks = flow_tracks(request.view.rgb, instances, flow=load())
        return {field: value.numpy() for field, value in vars(tracks).items()}

    arrays = request.cache.get("tracks", name, {"masks": digest_of(instances), **settings}, compute)
    return PointTracks(**{field: torch.from_numpy(value) for field, value in arrays.items()})
