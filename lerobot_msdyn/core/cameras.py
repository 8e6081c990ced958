"""Pinhole cameras over time, and the simplest of them: one that stands still with a given field of view."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.geometry import invert_se3


@dataclass(frozen=True)
class CameraTrack:
    """A pinhole camera at every frame of an episode (distortion-free, OpenCV axes)."""

    intrinsics: Float[Tensor, "t 3 3"]  # px
    world_from_camera: Float[Tensor, "t 4 4"]  # m
    width: int
    height: int
    origin: str = "assumed"  # or: calibration, column, exchange, sfm, fov_search
    world: str = ""  # name of the frame of its poses, which videos with the same name share; empty: this video's own

    def __len__(self) -> int:
        return self.intrinsics.shape[0]

    @property
    def camera_from_world(self) -> Float[Tensor, "t 4 4"]:
        """The view matrices."""
        return invert_se3(self.world_from_camera)

    @property
    def is_static(self) -> bool:
        """Whether pose and intrinsics are the same at every frame."""
        return bool(
            (self.world_from_camera == self.world_from_camera[:1]).all()
            and (self.intrinsics == self.intrinsics[:1]).all()
        )

    @property
    def path_length(self) -> float:
        """How far it goes from frame to frame, all in all; m."""
        places = self.world_from_camera[:, :3, 3]
        return float((places[1:] - places[:-1]).norm(dim=-1).sum())

    def select(self, frames: slice | list[int] | Tensor) -> "CameraTrack":
        """The camera at some of its frames."""
        return replace(self, intrinsics=self.intrinsics[frames], world_from_camera=self.world_from_camera[frames])

    def resized(self, width: int, height: int) -> "CameraTrack":
        """The same camera with another number of pixels."""
        scale = torch.tensor([[width / self.width], [height / self.height], [1.0]], device=self.intrinsics.device)
        return replace(self, intrinsics=self.intrinsics * scale, width=width, height=height)

    def cropped(self, rows: slice, columns: slice) -> "CameraTrack":
        """The same camera with some of its pixels alone, from a first to before a last row and column."""
        intrinsics = self.intrinsics.clone()
        intrinsics[:, 0, 2] -= columns.start
        intrinsics[:, 1, 2] -= rows.start
        return replace(self, intrinsics=intrinsics, width=columns.stop - columns.start, height=rows.stop - rows.start)


def concatenated(parts: Sequence[CameraTrack]) -> CameraTrack:
    """One camera's tracks over consecutive times, as one."""
    intrinsics = torch.cat([part.intrinsics for part in parts])
    return replace(
        parts[0], intrinsics=intrinsics, world_from_camera=torch.cat([part.world_from_camera for part in parts])
    )


def intrinsics_from_fov(width: int, height: int, horizontal_fov_deg: float) -> Float[Tensor, "3 3"]:
    """Pinhole matrix of a centred camera with square pixels and the given horizontal field of view."""
    focal = 0.5 * width / math.tan(math.radians(horizontal_fov_deg) / 2)
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def static_camera(
    intrinsics: Float[Tensor, "3 3"],
    frames: int,
    width: int,
    height: int,
    world_from_camera: Float[Tensor, "4 4"] | None = None,
) -> CameraTrack:
    """A camera that stands still for `frames` frames; without a pose, its own frame is the world's."""
    pose = torch.eye(4) if world_from_camera is None else world_from_camera
    return CameraTrack(
        intrinsics.float().expand(frames, 3, 3).contiguous(),
        pose.float().expand(frames, 4, 4).contiguous(),
        width,
        height,
    )
