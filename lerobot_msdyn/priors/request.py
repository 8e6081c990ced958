"""What a provider is given, and how `auto` goes from the best provider to the next."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from jaxtyping import UInt8
from torch import Tensor

from lerobot_msdyn.core.config import CameraConfig, PriorsConfig
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import Origin, View
from lerobot_msdyn.priors.cache import PriorCache
from lerobot_msdyn.priors.exchange import Exchange, exchange_path, read_exchange

logger = logging.getLogger(__name__)

FILE = ".npz"


@dataclass(frozen=True)
class Request:
    """One camera's video and what is asked about it."""

    view: View
    config: PriorsConfig
    camera: CameraConfig
    cache: PriorCache
    others: Sequence[View] = ()  # of the same moments, by other cameras
    elsewhere: UInt8[Tensor, "m h w 3"] | None = None  # frames of other episodes of the same fixed camera
    episode: int | None = None
    key: str | None = None  # of the camera's feature
    device: str = "cpu"  # on which networks run
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


@dataclass(frozen=True)
class Candidate[T]:
    """A provider that could be run; `why` is said when `auto` takes it."""

    provider: str
    why: str
    run: Callable[[str], tuple[T, Origin]]  # given the reason


def first_that_works[T](prior: str, candidates: Sequence[Candidate[T]]) -> tuple[T, Origin]:
    """The result of the best candidate; one that fails is named in a warning and the next is tried.

    Raises:
        PriorError: the last one fails as well.
    """
    for candidate in candidates[:-1]:
        try:
            return candidate.run(candidate.why)
        except PriorError as error:
            logger.warning("%s: %s cannot be used: %s", prior, candidate.provider, error)
    return candidates[-1].run(candidates[-1].why)
