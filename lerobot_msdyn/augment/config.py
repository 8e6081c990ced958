"""What the command line of `augment` sets; no torch here, so that `--help` answers at once."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_msdyn.core.command_help import Essentials
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.fields import between


@dataclass
class AugmentConfig(Recipe):
    """`python -m lerobot_msdyn.augment`: new camera viewpoints for every episode of a LeRobot dataset."""

    # Source dataset (alias: --repo).
    repo_id: str = ""
    # Exact folder of the source dataset; default: LeRobot's home, then the hub.
    root: Path | None = None
    # Name of the new dataset; default: the source's name followed by _msdyn.
    new_repo_id: str | None = None
    # Exact folder of the new dataset; default: LeRobot's home, or beside --root.
    new_root: Path | None = None
    # Source episodes to use, e.g. 0, 0,3 or 0-9; default: all.
    episodes: list[int] | None = None
    # Share of the episodes that get new ones; these are chosen to cover all tasks and the ways they were done.
    episodes_share: float = between(1.0, 0.001, 1.0)
    # How far (s) a video frame may be from its row's time, as LeRobot's tolerance_s; irrelevant where a video has
    # as many frames as its episode has rows, which are then matched by number.
    tolerance_s: float = between(1e-4, 0.0, 1.0)
    # Episodes that are worked on at the same time; 0: one per core, as far as memory allows. The result is the same.
    workers: int = between(0, 0, 1024)
    # Report what would be done (episodes, disk, time) and stop.
    dry_run: bool = False
    # Log what each stage finds in each episode, not only how each episode went.
    verbose: bool = False
    # Discard what an unfinished run for the same output has finished, instead of continuing it.
    restart: bool = False
    # Download a depth model where depth would otherwise be assumed (a table plane).
    fetch_models: bool = False
    # Work on a converted copy of a source of version v2.1; the source stays as it is.
    convert: bool = False


ESSENTIALS = Essentials(
    fields=(
        "repo_id",
        "root",
        "new_repo_id",
        "episodes",
        "cameras",
        "variants",
        "episodes_share",
        "fetch_models",
        "dry_run",
        "workers",
    ),
    examples=(
        "--repo local/ds",
        "--repo local/ds --episodes 0-2 --recipe quick",
        "--repo local/ds --dry-run",
    ),
)
