"""What a provider is given."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from jaxtyping import UInt8
from torch import Tensor

from lerobot_msdyn.core.config import CameraConfig, PriorsConfig
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.priors.cache import PriorCache
from lerobot_msdyn.priors.exchange import Exchange, read_exchange
from lerobot_msdyn.priors.files import exchange_path


@dataclass(frozen=True)
class Request:
    """One camera's video and what is asked about it."""

    view: View  # its camera is the provided one, once there is one
    config: PriorsConfig
    camera: CameraConfig
    cache: PriorCache  # of this video
    others: Sequence[View] = ()  # of the same moments, by other cameras
    elsewhere: UInt8[Tensor, "m h w 3"] | None = None  # frames of other episodes of the same fixed camera
    episode: int | None = None
    key: str | None = None  # of the camera's feature
    device: str = "cpu"  # on which networks run: cpu or cuda
    _files: dict[str, Exchange] = field(default_factory=dict)

    def exchange(self, pattern: str) -> Exchange:
        """The exchange file of this episode and camera, read once.

        Raises:
            PriorError: it cannot be read or is of another video.
        """
        if pattern not in self._files:
            path = exchange_path(pattern, self.episode, self.key)
            frames, height, width = self.view.rgb.shape[:3]
            self._files[pattern] = read_exchange(path, frames, height, width, self.episode, self.key)
        return self._files[pattern]
