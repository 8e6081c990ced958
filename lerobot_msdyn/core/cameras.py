"""Cameras over time, and where they come from: a calibration file, or a fixed camera with a default field of view."""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.geometry import invert_se3, se3


@dataclass(frozen=True)
class CameraTrack:
    """A pinhole camera at every frame of an episode (distortion-free, OpenCV axes)."""

    intrinsics: Float[Tensor, "t 3 3"]  # px
    world_from_camera: Float[Tensor, "t 4 4"]  # m
    width: int
    height: int
    origin: str = "assumed"  # or: calibration, exchange, sfm, fov_search

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

    def select(self, frames: slice | list[int] | Tensor) -> "CameraTrack":
        """The camera at some of its frames."""
        return replace(self, intrinsics=self.intrinsics[frames], world_from_camera=self.world_from_camera[frames])

    def resized(self, width: int, height: int) -> "CameraTrack":
        """The same camera with another number of pixels."""
        scale = torch.tensor([[width / self.width], [height / self.height], [1.0]], device=self.intrinsics.device)
        return replace(self, intrinsics=self.intrinsics * scale, width=width, height=height)


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


def read_calibration(path: Path, camera: str, episode: int, frames: int, width: int, height: int) -> CameraTrack | None:
    """The camera of one feature in a calibration file, or None if the file does not name it.

    The file (JSON) holds `{"cameras": {NAME: {"K": 3x3, "R": 3x3, "t": 3}}}` or, where the rig moved between
    episodes, `{"episodes": {"0": {"cameras": {...}}}}`. K is in pixels of the recorded image; R and t (metres) map
    world to camera (OpenCV); without them the camera's own frame is the world's. NAME is the feature's key, its
    last part (`front` for `observation.images.front`), or the number at its end (`0` for `observation.images.cam0`).

    Raises:
        PriorError: the file cannot be read or an entry has the wrong shape.
    """
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise PriorError(f"{path}: calibration cannot be read ({error}); expected a JSON file") from error
    section = content.get("episodes", {}).get(str(episode), content)
    cameras = section.get("cameras", {})
    entry = next((cameras[name] for name in _names(camera) if name in cameras), None)
    if entry is None:
        return None
    try:
        intrinsics = torch.tensor(entry["K"], dtype=torch.float32).reshape(3, 3)
        rotation = torch.tensor(entry.get("R", torch.eye(3).tolist()), dtype=torch.float64).reshape(3, 3)
        translation = torch.tensor(entry.get("t", [0.0, 0.0, 0.0]), dtype=torch.float64).reshape(3)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise PriorError(
            f"{path}: camera {camera!r} has no usable K (3x3), R (3x3), t (3): {error}; see docs/calibration.md"
        ) from error
    world_from_camera = invert_se3(se3(rotation, translation)).float()
    return replace(static_camera(intrinsics, frames, width, height, world_from_camera), origin="calibration")


def _names(camera: str) -> list[str]:
    """What a calibration file may call a camera."""
    last = camera.rsplit(".", 1)[-1]
    number = re.search(r"\d+$", last)
    return [camera, last, *([number[0]] if number else [])]
