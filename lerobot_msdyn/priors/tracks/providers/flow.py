"""Point tracks without learned weights: chained optical flow by DIS."""

from lerobot_msdyn.core.observations import PointTracks
from lerobot_msdyn.priors.registry import TRACKS, Estimate, Masks, TrackProvider
from lerobot_msdyn.priors.request import Request
from lerobot_msdyn.priors.tracks.chained import chained_tracks


@TRACKS.register("flow")
class Flow(TrackProvider):
    """Can always be used."""

    rank = 10

    def estimate(self, request: Request, instances: Masks) -> Estimate[PointTracks]:
        """See `flow_tracks`."""
        return Estimate(chained_tracks(request, instances, "flow", {}, lambda: None))
