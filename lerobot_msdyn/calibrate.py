"""Command line: where the cameras of a robot stand, by its joints and what moves in its videos.

python -m lerobot_msdyn.calibrate --repo local/ds --robot.name so101 --out calibration.json
"""

import json
import logging
import sys
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_msdyn.core.cli import EXIT_OK, EXIT_SOME_EPISODES_FAILED, parse_config, run_command
from lerobot_msdyn.core.config import RobotConfig
from lerobot_msdyn.core.errors import ConfigError, OutputError, PriorError
from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.files import write_whole

logger = logging.getLogger(__name__)

COMMAND = "python -m lerobot_msdyn.calibrate"


@dataclass
class CalibrateConfig:
    """`python -m lerobot_msdyn.calibrate`: pose and focal length of fixed cameras, from the joints and the videos."""

    # Source dataset (alias: --repo).
    repo_id: str = ""
    # Exact folder of the source dataset; default: LeRobot's home, then the hub.
    root: Path | None = None
    # Cameras, by feature key or its last part; default: all but wrist cameras.
    cameras: list[str] | None = None
    # Episodes, e.g. 0, 0,3 or 0-9; default: all. Where a camera was moved between them, each place is found by itself.
    episodes: list[int] | None = None
    # At most so many episodes of each place are looked at closely, evenly spread.
    max_episodes: int = between(10, 1, 1000)
    # Frames that are looked at of each place.
    frames: int = between(96, 12, 1000)
    # The calibration file that is written, for --camera.calibration; pictures are written beside it.
    out: Path = Path("calibration.json")
    robot: RobotConfig = field(default_factory=RobotConfig)


ALIASES = {"repo": "repo_id"}


def run(arguments: list[str]) -> int:
    """Calibrate, write and show; returns the exit code."""
    config = parse_config(CalibrateConfig, arguments, ALIASES, command=COMMAND)
    if not config.repo_id:
        raise ConfigError(f"--repo is missing; expected: {COMMAND} --repo NAME [--root FOLDER] [--robot.name so101]")
    from lerobot_msdyn.augment.robot_cameras import robot_cameras, summary
    from lerobot_msdyn.dataset.read import open_source
    from lerobot_msdyn.dataset.select import select_cameras, select_episodes

    source = open_source(config.repo_id, config.root)
    episodes = select_episodes(source, config.episodes)
    keys = select_cameras(source, config.cameras)
    found = robot_cameras(source, keys, episodes, config.robot, config.frames, config.max_episodes)
    for name, where, place in found.named():
        if place.verdict is not None:
            picture = config.out.with_name(f"{config.out.stem}_{name}.png")
            _written(picture, found.picture(place))
            sys.stdout.write(f"{where}  {summary(place.verdict)}\n{picture}\n")
        if place.doubt:
            logger.error("%s is left out: %s", where, place.doubt)
    if not found.believed:
        raise PriorError(
            f"{config.repo_id}: no camera could be told by {found.robot.name}'s joints: nothing was written"
        )
    _written(config.out, json.dumps(found.content(source), indent=1).encode())
    sys.stdout.write(f"{config.out}\n")
    complete = not any(place.doubt for _, _, place in found.named())
    return EXIT_OK if complete else EXIT_SOME_EPISODES_FAILED


def _written(path: Path, content: bytes) -> None:
    try:
        write_whole(path, content)
    except OSError as error:
        raise OutputError(f"{path} cannot be written ({error}); choose another place by --out") from error


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
