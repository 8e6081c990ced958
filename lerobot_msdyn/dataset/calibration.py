"""The recorded camera: from a calibration file (docs/calibration.md), else fixed with a default field of view."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov, static_camera
from lerobot_msdyn.core.config import CameraConfig
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.geometry import invert_se3, se3
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
    content = _content(path)
    try:
        section = content.get("episodes", {}).get(str(episode), content)
        cameras: dict[str, Any] = dict(section.get("cameras", {}))
    except (ValueError, AttributeError, TypeError) as error:
        raise PriorError(
            f"{path}: calibration cannot be read ({error}); expected a JSON file with the cameras by name, see "
            "docs/calibration.md"
        ) from error
    entry = next((cameras[name] for name in _names(camera) if name in cameras), None)
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
    entry = _content(path).get("robot")
    return None if entry is None else read_record(entry, path)


def _content(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise PriorError(
            f"{path}: calibration cannot be read ({error}); expected a JSON file with the cameras by name, see "
            "docs/calibration.md"
        ) from error


def _names(camera: str) -> list[str]:
    """What a calibration file may call a camera."""
    last = camera.rsplit(".", 1)[-1]
    number = re.search(r"\d+$", last)
    return [camera, last, *([number[0]] if number else [])]
