"""A calibration file (docs/calibration.md) as it is written, before anything is made of it. Without torch."""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lerobot_msdyn.core.errors import PriorError


def read_calibration_file(path: Path) -> dict[str, Any]:
    """What the file holds.

    Raises:
        PriorError: it cannot be read.
    """
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise _unreadable(path, error) from error


def camera_entry(path: Path, camera: str, episode: int) -> Any:
    """What the file says of a camera in an episode; None if it does not name it.

    Raises:
        PriorError: the file cannot be read.
    """
    return _entry(read_calibration_file(path), path, camera, episode)


def names_camera(path: Path, camera: str, episodes: Iterable[int]) -> bool:
    """Whether the file names a camera in any of some episodes.

    Raises:
        PriorError: the file cannot be read.
    """
    content = read_calibration_file(path)
    return any(_entry(content, path, camera, episode) is not None for episode in episodes)


def _entry(content: dict[str, Any], path: Path, camera: str, episode: int) -> Any:
    try:
        section = content.get("episodes", {}).get(str(episode), content)
        cameras: dict[str, Any] = dict(section.get("cameras", {}))
    except (ValueError, AttributeError, TypeError) as error:
        raise _unreadable(path, error) from error
    return next((cameras[name] for name in _names(camera) if name in cameras), None)


def _names(camera: str) -> list[str]:
    """What a calibration file may call a camera."""
    last = camera.rsplit(".", 1)[-1]
    number = re.search(r"\d+$", last)
    return [camera, last, *([number[0]] if number else [])]


def _unreadable(path: Path, error: Exception) -> PriorError:
    return PriorError(
        f"{path}: calibration cannot be read ({error}); expected a JSON file with the cameras by name, see "
        "docs/calibration.md"
    )
