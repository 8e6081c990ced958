"""The recorded camera: from a calibration file (docs/calibration.md), else fixed with a default field of view."""

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov, static_camera
from lerobot_msdyn.core.config import CameraConfig
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.geometry import invert_se3, se3
from lerobot_msdyn.dataset.calibration_file import camera_entry, read_calibration_file
from lerobot_msdyn.robots.calibration.record import RobotRecord, read_record


def make_camera(key: str, index: int, rgb: UInt8[Tensor, "t h w 3"], config: CameraConfig) -> CameraTrack:
    """The calibrated camera, or a fixed one with the configured field of view."""
    frames, height, width = rgb.shape[:3]
    if config.calibration is not None:
        camera = read_calibration(config.calibration, key, index, frames, width, height)
        if camera is not None:
            return camera
    return static_camera(intrinsics_from_fov(width, height, config.horizontal_fov_deg), frames, width, height)


def read_calibration(path: Path, camera: str, episode: int, frames: int, width: int, height: int) -> CameraTrack | None:
    """The camera of one feature in a calibration file, or None if the file does not name it.

    The file (JSON) holds `{"cameras": {NAME: {"K": 3x3, "R": 3x3, "t": 3}}}` or, where the rig moved between
    episodes, `{"episodes": {"0": {"cameras": {...}}}}`. K is in pixels of the recorded image; R and t (metres) map
    world to camera (OpenCV); without them the camera's own frame is the world's. NAME is the feature's key, its
    last part (`front` for `observation.images.front`), or the number at its end (`0` for `observation.images.cam0`).

    Raises:
        PriorError: the file cannot be read or an entry has the wrong shape.
    """
    entry = camera_entry(path, camera, episode)
    if entry is None:
        return None
    try:
        intrinsics = torch.tensor(entry["K"], dtype=torch.float32).reshape(3, 3)
        rotation = torch.tensor(entry.get("R", torch.eye(3).tolist()), dtype=torch.float64).reshape(3, 3)
        translation = torch.tensor(entry.get("t", [0.0, 0.0, 0.0]), dtype=torch.float64).reshape(3)
    except (KeyError, AttributeError, TypeError, ValueError, RuntimeError) as error:
        raise PriorError(
            f"{path}: camera {camera!r} has no usable K (3x3), R (3x3), t (3): {error}; see docs/calibration.md"
        ) from error
    world_from_camera = invert_se3(se3(rotation, translation)).float()
    world = "calibration" if "R" in entry or "t" in entry else ""
    fixed = static_camera(intrinsics, frames, width, height, world_from_camera)
    return replace(fixed, origin="calibration", world=world)


def read_robot(path: Path) -> RobotRecord | None:
    """The robot of a calibration file, whose root's frame is the cameras' world; None if it names none.

    Raises:
        PriorError: the file cannot be read, or its entry `robot` cannot be used.
    """
    entry = read_calibration_file(path).get("robot")
    return None if entry is None else read_record(entry, path)
