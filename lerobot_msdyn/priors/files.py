"""The files about cameras and priors that settings name, and whether they are there. Without torch."""

from pathlib import Path

from lerobot_msdyn.core.config import CameraConfig, PriorsConfig
from lerobot_msdyn.core.errors import PriorError, first_line
from lerobot_msdyn.core.fields import FILE
from lerobot_msdyn.dataset.calibration_file import read_calibration_file


def exchange_path(pattern: str, episode: int | None, camera: str | None) -> Path:
    """The file that a setting names; `{episode}` and `{camera}` in it stand for those of the video.

    Raises:
        PriorError: there is something else in braces.
    """
    try:
        return Path(pattern.format(episode=0 if episode is None else episode, camera=camera or "camera")).expanduser()
    except (KeyError, ValueError, IndexError, AttributeError) as error:
        raise PriorError(f"{pattern!r} names no file: in braces only {{episode}} and {{camera}} are known") from error


def check_files(camera: CameraConfig, priors: PriorsConfig | None) -> None:
    """Whether there are the calibration and the exchange files that settings name for all episodes and cameras alike.

    Args:
        camera: the settings of cameras.
        priors: those of priors; None: no episode is fitted, and exchange files are not read.

    Raises:
        PriorError: one cannot be read.
    """
    if camera.calibration is not None:
        read_calibration_file(camera.calibration)
    patterns = () if priors is None else (camera.poses, priors.masks, priors.depth, priors.tracks)
    for pattern in patterns:
        path = exchange_path(pattern, None, None) if pattern.endswith(FILE) else None
        if path is not None and "{" not in pattern:
            try:
                path.open("rb").close()
            except OSError as error:
                raise unreadable(path, error) from error


def unreadable(path: Path, error: Exception) -> PriorError:
    """What to say of an exchange file that cannot be read."""
    return PriorError(f"{path}: not a readable npz file of plain arrays ({first_line(error)}); see docs/priors.md")
