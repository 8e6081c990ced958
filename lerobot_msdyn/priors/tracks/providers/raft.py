"""Point tracks by chained optical flow of RAFT."""

import hashlib

from lerobot_msdyn.core.observations import PointTracks
from lerobot_msdyn.priors.registry import TRACKS, Estimate, Masks, TrackProvider
from lerobot_msdyn.priors.request import Request
from lerobot_msdyn.priors.tracks.chained import chained_tracks
from lerobot_msdyn.priors.tracks.raft import RaftFlow, raft_weights


@TRACKS.register("raft")
class Raft(TrackProvider):
    """The weights are those of `priors.raft_weights`, else where torchvision keeps them."""

    rank = 40

    def usable(self, request: Request) -> str:
        """They are there."""
        raft_weights(request.config.raft_weights)
        return "its weights are on this machine"

    def estimate(self, request: Request, instances: Masks) -> Estimate[PointTracks]:
        """See `flow_tracks`."""
        model = raft_weights(request.config.raft_weights)
        weights = hashlib.sha256(model.folder.read_bytes()).hexdigest()
        settings = {"revision": model.revision, "weights": weights}
        tracks = chained_tracks(request, instances, "raft", settings, lambda: RaftFlow(model, request.device))
        return Estimate(tracks, model=model)
