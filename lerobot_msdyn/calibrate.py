"""Command line: where the cameras of a robot stand, by its joints and what moves in its videos.

python -m lerobot_msdyn.calibrate --repo local/ds --robot.name so101 --out calibration.json
python -m lerobot_msdyn.calibrate --repo local/ds --robot.name so101 --cameras wrist --link gripper_link --out poses
"""

import json
import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_msdyn.core.cli import EXIT_OK, EXIT_SOME_EPISODES_FAILED, parse_config, run_command
from lerobot_msdyn.core.config import RobotConfig
from lerobot_msdyn.core.errors import ConfigError, OutputError, PriorError
from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.files import write_whole
from lerobot_msdyn.dataset.named import check_there

if TYPE_CHECKING:
    from lerobot_msdyn.dataset.select import Listing

logger = logging.getLogger(__name__)

COMMAND = "python -m lerobot_msdyn.calibrate"


@dataclass
class CalibrateConfig:
    """`python -m lerobot_msdyn.calibrate`: where fixed cameras stand, or one on a link, by joints and videos."""

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
    # The calibration file that is written, for --camera.calibration (default: calibration.json), with pictures beside
    # it; with --link, the folder of poses (default: poses).
    out: Path | None = None
    # Link on which the camera of --cameras rides: its poses in all frames are written, for --camera.poses.
    link: str = ""
    robot: RobotConfig = field(default_factory=RobotConfig)


ALIASES = {"repo": "repo_id"}


def run(arguments: list[str]) -> int:
    """Calibrate, write and show; returns the exit code."""
    config = parse_config(CalibrateConfig, arguments, ALIASES, command=COMMAND)
    if not config.repo_id:
        raise ConfigError(f"--repo is missing; expected: {COMMAND} --repo NAME [--root FOLDER] [--robot.name so101]")
    check_there(config.repo_id, config.root)
    from lerobot_msdyn.dataset.metadata import described  # needs neither LeRobot nor torch, which take long
    from lerobot_msdyn.robots import check_description

    meta = described(config.repo_id, config.root)
    if meta is not None:
        _chosen(config, meta)
        check_description(config.robot, meta.robot_type)
    from lerobot_msdyn.augment.riding_cameras import riding_camera
    from lerobot_msdyn.augment.robot_cameras import NAME, robot_cameras, summary
    from lerobot_msdyn.dataset.read import open_source

    source = open_source(config.repo_id, config.root)
    episodes, keys = _chosen(config, source)
    if config.link:
        riding = riding_camera(source, keys[0], config.link, episodes, config.robot, config.max_episodes)
        sys.stdout.write(f"{riding}\n")
        out = config.out or Path("poses")
        whole = _poses_written(out, riding.write(source, out)) == len(episodes)
        return EXIT_OK if whole else EXIT_SOME_EPISODES_FAILED
    out = config.out or Path(NAME)
    found = robot_cameras(source, keys, episodes, config.robot, config.frames, config.max_episodes)
    for name, where, place in found.named():
        if place.verdict is not None:
            picture = out.with_name(f"{out.stem}_{name}.png")
            _written(picture, found.picture(place))
            sys.stdout.write(f"{where}  {summary(place.verdict)}\n{picture}\n")
        if place.doubt:
            logger.error("%s is left out: %s", where, place.doubt)
    if not found.believed:
        raise PriorError(
            f"{config.repo_id}: no camera could be told by {found.robot.name}'s joints: nothing was written"
        )
    _written(out, json.dumps(found.content(source), indent=1).encode())
    sys.stdout.write(f"{out}\n")
    complete = not any(place.doubt for _, _, place in found.named())
    return EXIT_OK if complete else EXIT_SOME_EPISODES_FAILED


def _chosen(config: CalibrateConfig, meta: "Listing") -> tuple[list[int], list[str]]:
    """The episodes, and the feature keys of the cameras."""
    from lerobot_msdyn.dataset.select import select_cameras, select_episodes

    episodes = select_episodes(meta, config.episodes)
    keys = select_cameras(meta, config.cameras, allow_moving=bool(config.link))
    if config.link and len(keys) != 1:
        raise ConfigError(f"--link is for one camera, which --cameras names; got {', '.join(keys)}")
    return episodes, keys


def _poses_written(out: Path, files: Iterator[Path]) -> int:
    """How many there are."""
    try:
        count = len(list(files))
    except OSError as error:
        raise OutputError(f"{out} cannot be written ({error}); choose another folder by --out") from error
    pattern = out / "episode_{episode:06d}" / "{camera}.npz"
    sys.stdout.write(f"{count} files, for --camera.poses '{pattern}'\n")
    return count


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
