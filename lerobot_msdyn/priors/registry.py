"""Providers of masks, cameras, depth and point tracks: what each is given, what it returns, and how it registers.

A provider is a class in a file of its own, under `providers/` or anywhere else (docs/extending.md):

    @DEPTH.register("my_depth")
    class MyDepth(DepthProvider):
        rank = 45  # `auto` tries it before the networks

        def usable(self, request: Request) -> str:
            if not MODEL.exists():
                raise Unusable("my model is not on this machine", "fetch it with: ...")
            return "my model is on this machine"

        def estimate(self, request: Request, instances: Masks) -> Estimate[Depth]:
            metres = predict(request.view.rgb)
            return Estimate(Depth(metres, DepthTraits(metric=True)), model=Model("me/my_model", licence="MIT"))

A fault in the input or in what is at hand is a PriorError; any other error is one of the provider's own.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core import registries
from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import PriorsConfig
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import DepthTraits, Model, PointTracks, View
from lerobot_msdyn.core.registry import Registry
from lerobot_msdyn.priors.request import Request

type Masks = UInt8[Tensor, "t h w"]  # 0 = static background, 1.. = moving instances


class Unusable(PriorError):  # noqa: N818  # a state of affairs, which `auto` takes as such
    """A provider cannot be used on this machine or on this video."""

    def __init__(self, why: str, fix: str = "") -> None:
        """`why` is a clause ("no depth is recorded"), `fix` what to do where the provider was asked for by name."""
        super().__init__(f"{why}; {fix}" if fix else why)
        self.why = why


@dataclass(frozen=True)
class Estimate[T]:
    """What a provider returns."""

    value: T
    how: str = ""  # how it came about, for the log and the output's metadata
    model: Model | None = None  # the learned model that it comes from
    provider: str = ""  # where it comes from, if that is not the provider itself: a calibration


@dataclass(frozen=True)
class Corners:
    """Single points of what stands still, whose depth a camera's way tells."""

    points: dict[int, Float32[ndarray, "_ 3"]]  # by frame: x, y (px), and z-depth in the unit of the poses
    unit_m: float  # that unit


@dataclass(frozen=True)
class Depth:
    """Depth of every frame."""

    z: Float[Tensor, "t h w"]  # m, z-depth; 0 = unknown
    traits: DepthTraits
    # m, of the ground that things stand on (and of a wall behind it), where depth is that of a ground.
    ground: Float[Tensor, "h w"] | None = None
    lying: frozenset[int] = frozenset()  # instances that lie on the ground throughout
    corners: Corners | None = None  # where depth is known at these alone


class Provider(ABC):
    """One way to get a prior. It is made once per video, and keeps nothing between videos.

    It is made without arguments, or, where it has a `parameter`, with the text behind its name and a colon.
    """

    prior: ClassVar[str]
    setting: ClassVar[str]
    registry: ClassVar[Registry[Any]]

    # `auto` tries the highest first; None: it is used only where it is asked for by name.
    rank: ClassVar[int | float | None] = None
    # What must stand behind its name and a colon in the settings, e.g. "FILE.onnx"; empty: it takes nothing.
    parameter: ClassVar[str] = ""
    # Whether it must see a video as a whole: then long ones are not fitted part by part, and `auto` leaves it out.
    needs_whole_videos: ClassVar[bool] = False

    def usable(self, request: Request) -> str:
        """Why it can be used on this video, for the log where `auto` takes it; empty if that needs no reason.

        It should take no time: nothing is loaded or computed.

        Raises:
            Unusable: it cannot.
        """
        return ""

    def check(self, config: PriorsConfig, device: str) -> None:
        """Find out, before any video is read, what speaks against it; called where it is asked for by name.

        Args:
            config: the settings of priors.
            device: on which networks run.

        Raises:
            PriorError: a file that it needs is absent or of no use.
        """
        return

    @staticmethod
    @abstractmethod
    def problem(value: Any, view: View) -> str:
        """What is wrong with what a provider returned; empty if nothing is."""


class MaskProvider(Provider):
    """Provides the instances of every frame."""

    prior, setting, registry = "masks", "priors.masks", registries.MASKS

    @abstractmethod
    def estimate(self, request: Request) -> Estimate[Masks]:
        """Instance of every pixel: 0 = static, 1, 2, ... = things that move at some time, also while they rest.

        Raises:
            PriorError: it cannot be had of this video; `auto` goes on to the next provider.
        """

    @staticmethod
    def problem(value: Any, view: View) -> str:
        """Its shape, unless it is right."""
        return _wrong_tensor("masks", value, view, torch.uint8)


class CameraProvider(Provider):
    """Provides intrinsics and poses of the camera."""

    prior, setting, registry = "camera", "camera.poses", registries.CAMERAS

    # Whether the camera is known without the video, as a file has it: then it is asked for, with masks in which nothing
    # moves, before any episode is worked on, and what episodes of the same `CameraTrack.world` show is shared.
    known_before: ClassVar[bool] = False

    @abstractmethod
    def estimate(self, request: Request, instances: Masks) -> Estimate[CameraTrack]:
        """The camera at every frame (OpenCV axes, m); `request.view.camera` is that of the calibration, or assumed.

        Raises:
            PriorError: it cannot be had of this video; `auto` goes on to the next provider.
        """

    @staticmethod
    def problem(value: Any, view: View) -> str:
        """Its number of frames or its size, unless they are the video's."""
        if not isinstance(value, CameraTrack):
            return f"a {type(value).__name__}; expected a CameraTrack"
        expected = (len(view), view.rgb.shape[2], view.rgb.shape[1])
        returned = (len(value), value.width, value.height)
        return "" if returned == expected else f"{_video(*returned)}; the video has {_video(*expected)}"


class DepthProvider(Provider):
    """Provides depth of every frame."""

    prior, setting, registry = "depth", "priors.depth", registries.DEPTH

    # Whether recorded depth (`request.view.depth`) is of use to it, also as what its own is aligned to: it is decoded.
    reads_recorded_depth: ClassVar[bool] = True
    # Whether depth without a scale may be aligned to this: it needs no network itself.
    is_reference: ClassVar[bool] = False

    @abstractmethod
    def estimate(self, request: Request, instances: Masks) -> Estimate[Depth]:
        """z-depth, and what can be relied on in it. `depth.metres.in_metres` gives depth without a scale its metres.

        Raises:
            PriorError: it cannot be had of this video; `auto` goes on to the next provider.
        """

    def reference(self, request: Request, instances: Masks) -> Estimate[Depth]:
        """What other depth is aligned to (`is_reference`), which may be less than the estimate.

        Raises:
            PriorError: it cannot be had of this video.
        """
        return self.estimate(request, instances)

    @staticmethod
    def problem(value: Any, view: View) -> str:
        """Its shape, or values that are no depth, unless all is right."""
        if not isinstance(value, Depth):
            return f"a {type(value).__name__}; expected a Depth"
        wrong = _wrong_tensor("depth", value.z, view, torch.float32)
        if not wrong and not bool((torch.isfinite(value.z) & (value.z >= 0)).all()):
            return "depth that is negative, infinite or NaN; expected metres, and 0 where it is unknown"
        return wrong


class TrackProvider(Provider):
    """Provides point tracks of what moves."""

    prior, setting, registry = "tracks", "priors.tracks", registries.TRACKS

    @abstractmethod
    def estimate(self, request: Request, instances: Masks) -> Estimate[PointTracks]:
        """Points of the instances, followed through the video. `tracks.labelled.on_instances` makes them of plain ones.

        Raises:
            PriorError: they cannot be had of this video; `auto` goes on to the next provider.
        """

    @staticmethod
    def problem(value: Any, view: View) -> str:
        """Its number of frames, or tracks of the background, unless all is right."""
        if not isinstance(value, PointTracks):
            return f"a {type(value).__name__}; expected PointTracks"
        count, frames = value.visible.shape
        if value.xy.shape != (count, len(view), 2) or frames != len(view):
            return f"tracks of {frames} frames; the video has {len(view)}"
        return "" if bool((value.instance > 0).all()) else "tracks of instance 0, the background; expected moving ones"


MASKS: Registry[type[MaskProvider]] = registries.MASKS
CAMERAS: Registry[type[CameraProvider]] = registries.CAMERAS
DEPTH: Registry[type[DepthProvider]] = registries.DEPTH
TRACKS: Registry[type[TrackProvider]] = registries.TRACKS


def _wrong_tensor(name: str, value: Any, view: View, kind: torch.dtype) -> str:
    if not isinstance(value, Tensor):
        return f"a {type(value).__name__}; expected a tensor"
    expected = tuple(view.rgb.shape[:3])
    if tuple(value.shape) != expected or value.dtype != kind:
        return f"{name} of shape {list(value.shape)}, {value.dtype}; expected {list(expected)}, {kind}"
    return ""


def _video(frames: int, width: int, height: int) -> str:
    return f"{frames} frames of {width}x{height} px"
