"""What a level of motion is: how it is estimated, and which of its bases a point follows (docs/extending.md).

A level is a class of one of two kinds that registers itself by name in `MOTION_LEVELS`. The first level of a scene is
estimated from tracks and their rigid parts; every finer one refines the level before it.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.registries import MOTION_LEVELS
from lerobot_msdyn.core.serialise import allow
from lerobot_msdyn.motion.finer.residual import ResidualTracks
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.model.compose import Level

Binding = tuple[Int[Tensor, "n _"], Float[Tensor, "n _"]]  # bases that each point follows, their weights before softmax


class LevelSpec(ABC):
    """A level of motion; its subclasses below are what registers."""

    after: ClassVar[tuple[str, ...]] = ()  # levels of which one stands right before it; none: it stands first
    before: ClassVar[tuple[str, ...]] = ()  # levels that may stand right after it although they do not name it
    frames_per_knot: ClassVar[int] = 1  # unless motion.frames_per_knot names the level
    settings: ClassVar[type | None] = None  # dataclass of what motion.settings.NAME may hold
    value: ClassVar[type] = MotionLevel  # class of the estimated level: a dataclass of tensors, see `Level`

    def __init_subclass__(cls) -> None:
        """Scenes and unfinished runs may keep values of its class."""
        super().__init_subclass__()
        allow(cls.value)

    @abstractmethod
    def bind(
        self, level: Any, points: Float[Tensor, "n 3"], part: Int[Tensor, " n"], coarser: Binding | None
    ) -> Binding:
        """The bases that points follow.

        Args:
            level: as it was estimated; of a finer level also one that does not move yet.
            points: canonical points, m.
            part: rigid part of each.
            coarser: their binding to the level before, if there is one.
        """


@dataclass(frozen=True)
class PartTracks:
    """Tracks, and what their rigid parts say of them: what a first level is estimated from."""

    objects: MotionLevel  # one rigid motion per part
    points: Float[Tensor, "n 3"]  # m, at the canonical frame
    part: Int[Tensor, " n"]
    xyz: Float[Tensor, "n t 3"]  # m; meaningless where the weight is 0
    weights: Float[Tensor, "n t"]  # 0 = not seen
    canonical: int  # frame
    noise: float  # m, standard deviation of a position along one axis


class FirstLevel(LevelSpec):
    """A level that may stand first."""

    rigid: ClassVar[bool] = False  # every point follows one basis alone
    by_video: ClassVar[bool] = False  # it is given parts that were registered to the video, where depth is metric

    @abstractmethod
    def estimate(self, tracks: PartTracks, config: MotionConfig) -> Level:
        """The level, which is the identity at the canonical frame."""


class FinerLevel(LevelSpec):
    """A level of bases that refines the one before it (motion/finer/add_level.py says how they are estimated)."""

    of_parts: ClassVar[bool] = False  # tracks are clustered within rigid parts, not within bases of the level before
    turns: ClassVar[bool] = True  # its bases turn as well as shift
    idle: ClassVar[bool] = False  # one more basis, the last one, is the identity, for points that follow no other
    refines: ClassVar[bool] = False  # where a basis of the level before is refused, so are those that refine it

    @abstractmethod
    def cluster(self, tracks: ResidualTracks, config: MotionConfig, noise: float) -> Int[Tensor, " n"]:
        """Labels 0, 1, ... of the tracks of one part, or of one basis of the level before: one basis per label.

        Args:
            tracks: what the coarser levels leave of their motion.
            config: of all levels; `config.settings_of` has the level's own settings.
            noise: standard deviation of a position along one axis, m.
        """


def level_spec(name: str) -> LevelSpec:
    """The level of a name.

    Raises:
        ConfigError: there is none.
    """
    spec: LevelSpec = MOTION_LEVELS.get(name)()
    return spec


def first_level(name: str) -> FirstLevel:
    """The level of a name, which may stand first.

    Raises:
        ConfigError: it may not, or there is none.
    """
    spec = level_spec(name)
    if not isinstance(spec, FirstLevel):
        raise ConfigError(f"motion level {name!r} cannot stand first; it stands after {' or '.join(spec.after)}")
    return spec


def finer_level(name: str) -> FinerLevel:
    """The level of a name, which stands after another.

    Raises:
        ConfigError: it stands first, or there is none.
    """
    spec = level_spec(name)
    if not isinstance(spec, FinerLevel):
        raise ConfigError(f"motion level {name!r} stands first; no level may stand before it")
    return spec


def frames_per_knot(name: str, config: MotionConfig) -> int:
    """Frames from one knot of a level's motion to the next."""
    return config.frames_per_knot.get(name, level_spec(name).frames_per_knot)
