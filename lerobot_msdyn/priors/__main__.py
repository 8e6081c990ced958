"""Command line: compute the priors of some episodes alone, write them as exchange files, and show them.

python -m lerobot_msdyn.priors --repo local/ds --episodes '[0]' --out DIR
"""

import logging
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_msdyn.core.cli import EXIT_OK, EXIT_SOME_EPISODES_FAILED, parse_config, run_command
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import ConfigError, EpisodeError, OutputError
from lerobot_msdyn.core.fields import between
from lerobot_msdyn.dataset.named import check_there

if TYPE_CHECKING:
    from lerobot_msdyn.dataset.read import Episode
    from lerobot_msdyn.dataset.select import Listing

logger = logging.getLogger(__name__)

COMMAND = "python -m lerobot_msdyn.priors"


@dataclass
class PriorsCommandConfig(Recipe):
    """`python -m lerobot_msdyn.priors`: compute the priors alone, and show them."""

    # Source dataset (alias: --repo).
    repo_id: str = ""
    # Exact folder of the source dataset; default: LeRobot's home, then the hub.
    root: Path | None = None
    # Episodes, e.g. 0, 0,3 or 0-9; default: all.
    episodes: list[int] | None = None
    # Where the results go: OUT/episode_000000/<camera>.npz and OUT/episode_000000.png.
    out: Path = Path()
    # Columns of the contact sheet.
    columns: int = between(6, 1, 100)


ALIASES = {"repo": "repo_id"}


def run(arguments: list[str]) -> int:
    """Compute, write and show; returns the exit code."""
    config = parse_config(PriorsCommandConfig, arguments, ALIASES, command=COMMAND)
    for name, given in (("repo", config.repo_id != ""), ("out", config.out != Path())):
        if not given:
            raise ConfigError(f"--{name} is missing; expected: {COMMAND} --repo NAME [--root FOLDER] --out DIR")
    check_there(config.repo_id, config.root)
    from lerobot_msdyn.dataset.metadata import described  # needs neither LeRobot nor torch, which take long
    from lerobot_msdyn.priors.files import check_files

    meta = described(config.repo_id, config.root)
    if meta is not None:
        _chosen(config, meta)
    check_files(config.camera, config.priors)
    from lerobot_msdyn.dataset.read import open_source, read_episode

    source = open_source(config.repo_id, config.root)
    cameras, episodes = _chosen(config, source)
    failures = []
    for index in episodes:
        try:
            recorded = config.priors.reads_recorded_depth
            one_episode(read_episode(source, index, cameras, config.camera, recorded_depth=recorded), config)
        except EpisodeError as error:
            logger.error("skipped: %s", error)
            failures.append(error)
    if len(failures) == len(episodes):
        raise failures[0]
    return EXIT_SOME_EPISODES_FAILED if failures else EXIT_OK


def _chosen(config: PriorsCommandConfig, meta: "Listing") -> tuple[list[str], list[int]]:
    """The feature keys of the cameras, and the episodes."""
    from lerobot_msdyn.dataset.select import select_cameras, select_episodes

    return select_cameras(meta, config.cameras), select_episodes(meta, config.episodes)


def one_episode(episode: "Episode", config: PriorsCommandConfig) -> None:
    """Write an exchange file per camera and one contact sheet.

    Raises:
        PriorError: a prior was demanded and cannot be had.
        OutputError: the folder cannot be written.
    """
    import cv2

    from lerobot_msdyn.priors import estimate_priors
    from lerobot_msdyn.priors.exchange import from_priors, write_exchange
    from lerobot_msdyn.priors.sheet import contact_sheet

    index, name = episode.source.index, f"episode_{episode.source.index:06d}"
    views = {key: view.shrunk(config.fit.max_width) for key, view in episode.views.items()}
    videos = []
    for key, view in views.items():
        start = time.perf_counter()
        others = [other for camera, other in views.items() if camera != key]
        priors = estimate_priors(
            view, config.priors, config.camera, others=others, episode=index, key=key, device=config.device
        )
        seconds = time.perf_counter() - start
        path = config.out / name / f"{key}.npz"
        try:
            write_exchange(path, from_priors(view, priors, index, key))
        except OSError as error:
            raise OutputError(f"{path} cannot be written ({error}); choose another folder by --out") from error
        sys.stdout.write(f"{path}  {len(view.rgb)} frames in {seconds:.1f} s\n")
        videos.append((f"{episode.source.repo_id} episode {index}, {key}", view, priors))
    picture = config.out / f"{name}.png"
    sheet = contact_sheet(videos, episode.fps, config.columns)
    if not cv2.imwrite(str(picture), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR)):
        raise OutputError(f"{picture} cannot be written")
    sys.stdout.write(f"{picture}\n")


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
