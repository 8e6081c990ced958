"""What every kind of camera change says of itself: an extension point, one file per kind (docs/extending.md).

A kind is a config, whose fields recipes and flags set, and the behaviour that goes with it. The change that it makes is
a value for each of `AMOUNTS`; no amount is no change, so that a change can be shrunk along its own path by a factor.
No torch here nor where a kind is defined, so that `--help` answers at once.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import draccus
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.plugins import import_plugins, imported_plugins
from lerobot_msdyn.core.registry import Registry

if TYPE_CHECKING:
    from torch import Tensor

    from lerobot_msdyn.core.cameras import CameraTrack

AMOUNTS = (
    "azimuth_deg",  # about the vertical through the point that the camera looks at, to its right
    "elevation_deg",  # about the horizontal through the same point, up
    *("shift_x", "shift_y", "shift_z"),  # m, along the camera's axes (OpenCV: right, down, ahead)
    *("turn_x_deg", "turn_y_deg", "turn_z_deg"),  # about the camera's axes
    *("pan_deg", "tilt_deg"),  # in place: about the vertical, to the right; about the horizontal, up
    "log_zoom",  # logarithm of a factor of the focal length
)
LEVEL = (0.0, -1.0, 0.0)  # the vertical in the axes of a camera that looks straight ahead, unrolled (OpenCV)
PERTURBATIONS: Registry[type["Perturbation"]] = Registry("perturbation", "lerobot_msdyn.views.perturbations")


@dataclass(frozen=True)
class Viewpoint:
    """A recorded camera and what it looks at."""

    camera: "CameraTrack"
    distance: int | float  # m, to the point that it looks at
    metric: bool  # whether metres are true ones
    up: tuple[float, float, float] = LEVEL  # the vertical in the camera's axes
    other: "Tensor | None" = None  # [4,4], world from the camera that `Perturbation.needs_pose_of` names

    def shifts(self, metres: int | float, relative: int | float, axes: str = "xyz") -> dict[str, int | float]:
        """Amounts of a shift along some of the camera's axes: metres, or a share of the distance if these are not true.

        Args:
            metres: the shift where the scale is metric, m.
            relative: the shift elsewhere, as a share of the distance.
            axes: some of x, y, z.
        """
        shift = metres if self.metric else relative * self.distance
        return {f"shift_{axis}": shift for axis in axes}


class _Kinds(Mapping[str, type["Perturbation"]]):
    """The kinds by name; each is imported when it is asked for."""

    def __getitem__(self, name: str) -> type["Perturbation"]:
        return PERTURBATIONS.get(name)

    def __contains__(self, name: object) -> bool:
        return name in PERTURBATIONS

    def __iter__(self) -> Iterator[str]:
        return iter(PERTURBATIONS.names())

    def __len__(self) -> int:
        return len(PERTURBATIONS.names())


@dataclass
class Perturbation(draccus.ChoiceRegistry):
    """How the camera of a new episode differs from the recorded one (docs/views.md)."""

    # Whether calibrated cameras move as one body with the first of them; else each changes in its own axes.
    moves_rig: ClassVar[bool] = False
    # Whether `per_frame` is possible: the amounts are sampled, and have no course of their own over the episode.
    allows_per_frame: ClassVar[bool] = True
    # Whether a camera behind what the recorded one sees is refused as a mistake; else the change is shrunk.
    refuses_behind: ClassVar[bool] = False

    # Whether every frame has a sample of its own, for policies that see single frames; else one per new episode.
    per_frame: bool = False

    # What draccus asks of a choice; `@Perturbation.register_subclass("name")` makes a dataclass one.
    register_subclass = PERTURBATIONS.register
    get_choice_class = PERTURBATIONS.get
    get_choice_name = PERTURBATIONS.name_of
    get_known_choices = _Kinds

    @property
    def type_name(self) -> str:
        """Its name in a recipe, for messages."""
        try:
            return PERTURBATIONS.name_of(type(self))
        except ValueError:  # used from Python, without a name
            return type(self).__name__

    @property
    def needs_pose_of(self) -> str | None:
        """The calibrated camera whose pose `Viewpoint.other` must hold, if any."""
        return None

    def problems(self) -> list[str]:
        """What is wrong between fields."""
        if not self.per_frame or self.allows_per_frame:
            return []
        return ["per_frame is true; expected false for this type, which samples nothing per frame"]

    def bounds(self, view: Viewpoint) -> dict[str, int | float]:
        """The largest change of a camera: values for some of `AMOUNTS`, none for the others.

        Raises:
            ConfigError: the kind neither has bounds nor amounts of its own.
        """
        raise ConfigError(f"perturbation {self.type_name!r} has no bounds; expected a method bounds(view)")

    def shares(
        self, uniform: Float32[ndarray, "t n"], phases: Float32[ndarray, "t n"], frames: int
    ) -> Float32[ndarray, "s n"]:
        """Shares of the bounds, -1..1, one column per amount; one row for all frames, or one for each.

        Args:
            uniform: 0..1, spread evenly over episodes and their variants: one row, or with `per_frame` one per frame.
            phases: as many other values of that kind.
            frames: of the episode.
        """
        return 2 * uniform - 1

    def amounts(self, shares: Float32[ndarray, "s n"], view: Viewpoint, variant: int) -> Float32[ndarray, "s n"]:
        """The change of a camera: its `AMOUNTS`, one row for all frames, or one for each.

        Args:
            shares: from `shares`, the same for all cameras of an episode.
            view: the recorded camera.
            variant: number of the new episode among those of one source episode.

        Raises:
            ConfigError: the bounds name something else than `AMOUNTS`.
        """
        bounds = self.bounds(view)
        unknown = ", ".join(sorted(bounds.keys() - set(AMOUNTS)))
        if unknown:
            raise ConfigError(
                f"perturbation {self.type_name!r} bounds {unknown}; expected some of {', '.join(AMOUNTS)}"
            )
        return shares * np.array([bounds.get(name, 0.0) for name in AMOUNTS], np.float32)

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process first imports this one's plugins: the class may be from one of them."""
        return _new, (_Plugins(), type(self)), vars(self)


def check_pose(perturbation: Perturbation, other: object = None) -> None:
    """Whether the pose is there that a perturbation needs.

    Raises:
        ConfigError: it is not.
    """
    if perturbation.needs_pose_of is not None and other is None:
        raise ConfigError(
            f"perturbation {perturbation.type_name!r} needs the pose of camera {perturbation.needs_pose_of!r}, which "
            "is not kept with saved scenes; choose another type"
        )


class _Plugins:
    """Stands for what was imported by `--plugins`; unpickled, it has been imported."""

    def __reduce__(self) -> tuple[Any, ...]:
        return import_plugins, (list(imported_plugins()),)


def _new(_: object, kind: type[Perturbation]) -> Perturbation:
    return kind.__new__(kind)
