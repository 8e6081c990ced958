"""Which provider of point tracks is run, and its result."""

import functools
import hashlib

import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import Origin, PointTracks
from lerobot_msdyn.priors.cache import digest_of
from lerobot_msdyn.priors.hub import LocalModel, learned_origin
from lerobot_msdyn.priors.masks.provide import file_origin
from lerobot_msdyn.priors.request import FILE, Candidate, Request, first_that_works
from lerobot_msdyn.priors.tracks.flow import flow_tracks
from lerobot_msdyn.priors.tracks.raft import RaftFlow, demand_raft, find_raft


def provide_tracks(request: Request, instances: UInt8[Tensor, "t h w"]) -> tuple[PointTracks, Origin]:
    """Tracks of what moves, by the provider that `priors.tracks` names; `instances` are the masks.

    Raises:
        PriorError: it was asked for by name and cannot be had.
    """
    provider = request.config.tracks
    if provider.endswith(FILE):
        return _from_file(request, instances, provider)
    if provider == "flow":
        return _flow(request, instances, None, "asked for")
    if provider == "raft":
        return _flow(request, instances, demand_raft(request.config.raft_weights), "asked for")
    model = find_raft(request.config.raft_weights)
    candidates = [
        Candidate("flow", "RAFT's weights are not on this machine", functools.partial(_flow, request, instances, None))
    ]
    if model is not None:
        candidates.insert(
            0, Candidate("raft", "its weights are on this machine", functools.partial(_flow, request, instances, model))
        )
    return first_that_works("tracks", candidates)


def _flow(
    request: Request, instances: UInt8[Tensor, "t h w"], model: LocalModel | None, why: str
) -> tuple[PointTracks, Origin]:
    """Chained optical flow: by RAFT if there is a model, else by DIS."""
    provider = "flow" if model is None else "raft"

    def compute() -> dict[str, np.ndarray]:
        flow = None if model is None else RaftFlow(model, request.device)
        tracks = flow_tracks(request.view.rgb, instances, flow=flow)
        return {name: value.numpy() for name, value in vars(tracks).items()}

    settings = {"masks": digest_of(instances)}
    if model is not None:
        settings["revision"] = model.revision
        settings["weights"] = hashlib.sha256(model.folder.read_bytes()).hexdigest()
    found = request.cache.get("tracks", provider, settings, compute)
    tracks = PointTracks(**{name: torch.from_numpy(value) for name, value in found.items()})
    origin = Origin(provider, why) if model is None else learned_origin(provider, model, why)
    return tracks, origin


def _from_file(request: Request, instances: UInt8[Tensor, "t h w"], pattern: str) -> tuple[PointTracks, Origin]:
    content = request.exchange(pattern)
    if content.tracks is None or content.vis is None:
        raise PriorError(f"priors.tracks: {pattern} has no array `tracks`; see docs/priors.md")
    tracks = on_instances(content.tracks, content.vis, content.conf, instances)
    return tracks, file_origin(content.provenance.get("tracks"), pattern)


def on_instances(
    xy: Float32[ndarray, "n t 2"],
    visible: Bool[ndarray, "n t"],
    confidence: Float32[ndarray, "n t"] | None,
    instances: UInt8[Tensor, "t h w"],
) -> PointTracks:
    """The tracks (px) that lie on an instance for most of the time that they are seen."""
    frames, height, width = instances.shape
    at = torch.from_numpy(xy)
    seen = torch.from_numpy(visible) & ((at >= 0) & (at < torch.tensor([width, height]))).all(-1)
    column, row = at[..., 0].long().clamp(0, width - 1), at[..., 1].long().clamp(0, height - 1)
    under = torch.where(seen, instances[torch.arange(frames), row, column].long(), -1)
    votes = torch.stack([(under == i).sum(1) for i in range(int(instances.max()) + 1)], dim=1)
    instance = votes.argmax(1)
    kept = (instance > 0) & seen.any(1)
    sure = torch.ones(seen.shape) if confidence is None else torch.from_numpy(confidence).clamp(0, 1)
    return PointTracks(at[kept], seen[kept], torch.where(seen, sure, 0.0)[kept], instance[kept])
