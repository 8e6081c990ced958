"""What one camera recorded, and what its priors say of it: depth, instances, point tracks and the camera itself."""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack


@dataclass(frozen=True)
class DepthTraits:
    """What can be relied on in depth, as its provider states it."""

    metric: bool = False  # in true metres (a sensor or a calibration), not only plausible
    sharp: bool = False  # edges stand where those of the image do, and frames agree with each other
    relative_error: int | float = 0.05  # share of the depth by which it may be off without the video showing it
    assumed: bool = False  # nothing was measured: it is no evidence against any image
    still_error: int | float = 0.0  # the relative error of what keeps still, if that is more

    @property
    def measured(self) -> bool:
        """Whether it can tell which of two surfaces a point belongs to."""
        return self.sharp and not self.assumed


@dataclass(frozen=True)
class Model:
    """A learned model, as the log and files name it; what is not known is empty."""

    name: str = ""
    revision: str = ""
    licence: str = ""

    @property
    def line(self) -> str:
        """For the log."""
        revision = f"revision {self.revision}" if self.revision else ""
        return ", ".join(part for part in (self.name, revision, self.licence) if part)


@dataclass(frozen=True)
class Origin:
    """Which provider a prior comes from, and why that one."""

    provider: str
    why: str
    model: Model | None = None  # None where nothing learned is involved

    @property
    def line(self) -> str:
        """For the log."""
        model = "" if self.model is None else f" ({self.model.line})"
        return f"{self.provider}{model}: {self.why}"

    def entry(self) -> dict[str, str]:
        """For files: provider, why, model, revision and licence, as far as they are known."""
        model = Model() if self.model is None else self.model
        named = {"model": model.name, "revision": model.revision, "licence": model.licence}
        stated = {"provider": self.provider, "why": self.why, **named}
        return {name: value for name, value in stated.items() if value}


@dataclass(frozen=True)
class PointTracks:
    """Points followed through a video. A point's position means something only where it is visible."""

    xy: Float[Tensor, "n t 2"]  # px, pixel centres at half-integers
    visible: Bool[Tensor, "n t"]
    confidence: Float[Tensor, "n t"]  # 0..1
    instance: Int[Tensor, " n"]  # instance id of the point (never 0, the background)

    def __len__(self) -> int:
        return self.xy.shape[0]

    @classmethod
    def none(cls, frames: int) -> "PointTracks":
        """No points at all."""
        nothing = torch.zeros(0, frames)
        return cls(torch.zeros(0, frames, 2), nothing.bool(), nothing, torch.zeros(0, dtype=torch.long))


@dataclass(frozen=True)
class BodyTracks:
    """Points of rigid bodies whose motion is known, such as a robot's links."""

    xyz: Float[Tensor, "n t 3"]  # m, in the world, also where they are hidden
    visible: Bool[Tensor, "n t"]
    body: Int[Tensor, " n"]  # 0, 1, ...
    instance: int = 0  # instance id of all of them; 0: not told yet

    def select(self, frames: slice | Int[Tensor, " s"]) -> "BodyTracks":
        """The same at some of their frames."""
        return replace(self, xyz=self.xyz[:, frames], visible=self.visible[:, frames])


@dataclass(frozen=True)
class Priors:
    """Everything known about a video before any Gaussian is fitted."""

    depth: Float[Tensor, "t h w"]  # m, z-depth; 0 = unknown
    instances: UInt8[Tensor, "t h w"]  # 0 = static background, 1.. = moving instances
    tracks: PointTracks
    depth_traits: DepthTraits = DepthTraits()
    provenance: dict[str, dict[str, str]] = field(default_factory=dict)  # prior -> provider, why, model, licence
    camera: CameraTrack | None = None  # the one to use from here on; None: that of the video
    bodies: BodyTracks | None = None  # in place of the tracks of their instance

    @property
    def metric(self) -> bool:
        """Whether depth is in true metres."""
        return self.depth_traits.metric


@dataclass(frozen=True)
class RobotSeen:
    """What a robot's joints say of a video, by a calibration in whose world z points up."""

    depth: Float[Tensor, "t h w"]  # m, z-depth of the robot; 0 = none is there
    moving: Bool[Tensor, "t h w"]  # pixels of links that move during the episode
    bodies: BodyTracks  # those links
    ground_m: float  # height of what the robot stands on, in the world
    model: Model = Model()  # its description

    def select(self, frames: slice | Int[Tensor, " s"]) -> "RobotSeen":
        """The same at some of its frames."""
        bodies = self.bodies.select(frames)
        return replace(self, depth=self.depth[frames], moving=self.moving[frames], bodies=bodies)

    def resized(self, width: int, height: int) -> "RobotSeen":
        """The same with another number of pixels (the nearest ones)."""
        size = (width, height)
        depth = [cv2.resize(image, size, interpolation=cv2.INTER_NEAREST) for image in self.depth.numpy()]
        moving = [cv2.resize(image, size, interpolation=cv2.INTER_NEAREST) for image in self.moving.byte().numpy()]
        return replace(self, depth=torch.from_numpy(np.stack(depth)), moving=torch.from_numpy(np.stack(moving)).bool())


@dataclass(frozen=True)
class View:
    """What one camera recorded."""

    rgb: UInt8[Tensor, "t h w 3"]
    camera: CameraTrack
    depth: Float[Tensor, "t h w"] | None = None  # m, z-depth; as recorded, see `depth_range`
    depth_range: tuple[float, float] = (0.0, float("inf"))  # m; values at the ends mean "not measured"
    robot: RobotSeen | None = None  # where its calibration names a robot

    def __len__(self) -> int:
        return self.rgb.shape[0]

    def select(self, frames: slice | Int[Tensor, " s"]) -> "View":
        """The video at some of its frames."""
        depth = None if self.depth is None else self.depth[frames]
        robot = None if self.robot is None else self.robot.select(frames)
        return replace(self, rgb=self.rgb[frames], camera=self.camera.select(frames), depth=depth, robot=robot)

    def cropped(self, rows: slice, columns: slice) -> "View":
        """The same video in some rows and columns alone."""
        window = (slice(None), rows, columns)
        depth, robot = self.depth, self.robot
        return replace(
            self,
            rgb=self.rgb[window],
            camera=self.camera.cropped(rows, columns),
            depth=None if depth is None else depth[window],
            robot=None if robot is None else replace(robot, depth=robot.depth[window], moving=robot.moving[window]),
        )

    def shrunk(self, max_width: int) -> "View":
        """The same video with at most `max_width` columns; depth keeps its values (nearest pixel)."""
        height, width = self.rgb.shape[1:3]
        if width <= max_width:
            return self
        size = (max_width, round(height * max_width / width))
        rgb = np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in self.rgb.numpy()])
        depth: Float[Tensor, "t h w"] | None = None
        if self.depth is not None:
            images = [cv2.resize(image, size, interpolation=cv2.INTER_NEAREST) for image in self.depth.numpy()]
            depth = torch.from_numpy(np.stack(images))
        robot = None if self.robot is None else self.robot.resized(*size)
        return View(torch.from_numpy(rgb), self.camera.resized(*size), depth, self.depth_range, robot)
