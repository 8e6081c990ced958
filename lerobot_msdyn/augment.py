"""Command line: new viewpoints for every episode of a LeRobot dataset.

python -m lerobot_msdyn.augment --repo local/ds
"""

import logging
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import draccus

from lerobot_msdyn.cli import EXIT_OK, EXIT_SOME_EPISODES_FAILED, parse_config, run_command
from lerobot_msdyn.config import AugmentConfig
from lerobot_msdyn.errors import ConfigError, EpisodeError

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

logger = logging.getLogger(__name__)

COMMAND = "python -m lerobot_msdyn.augment"
ALIASES = {"repo": "repo_id"}


def run(arguments: list[str]) -> int:
    """Augment a dataset; returns the exit code."""
    config = parse_config(AugmentConfig, arguments, ALIASES, command=COMMAND)
    if not config.repo_id:
        raise ConfigError(f"which dataset? {COMMAND} --repo NAME [--root FOLDER] (see --help)")
    # LeRobot and torch take seconds to import: only now, so that --help and bad flags are answered at once.
    from lerobot.utils.constants import HF_LEROBOT_HOME

    from lerobot_msdyn.action_safety import still_cameras
    from lerobot_msdyn.episode import open_source, select_cameras, select_episodes

    source = open_source(config.repo_id, config.root)
    episodes = select_episodes(source, config.episodes)
    cameras = select_cameras(source, config.cameras, allow_moving=config.allow_moving)
    if not config.allow_moving:
        cameras = still_cameras(source, episodes[0], cameras, config)
    new_repo_id = config.new_repo_id or f"{config.repo_id}_msdyn"
    new_root = config.new_root
    if new_root is None and config.root is not None and config.new_repo_id is None:
        new_root = config.root.with_name(f"{config.root.name}_msdyn")
    return augment(config, source, episodes, cameras, new_repo_id, new_root or HF_LEROBOT_HOME / new_repo_id)


def augment(
    config: AugmentConfig,
    source: "LeRobotDatasetMetadata",
    episodes: list[int],
    cameras: list[str],
    new_repo_id: str,
    new_root: Path,
) -> int:
    """Run the job that the command line described and say how it went; returns the exit code."""
    from lerobot_msdyn.engines import plan, run_local
    from lerobot_msdyn.provenance import SOURCE_VARIANT
    from lerobot_msdyn.report.build import write_report
    from lerobot_msdyn.write import OutputDataset, check_place

    start = time.perf_counter()
    check_place(source, new_root)
    if config.dry_run:
        sys.stdout.write(plan(source, episodes, cameras, config) + f"would be written to {new_root}\n")
        return EXIT_OK
    with OutputDataset(source, new_repo_id, new_root) as output:
        made, failures = run_local(source, episodes, cameras, config, output)
        new = [episode for episode in made if not episode.dropped]
        dropped = [f"episode {e.source_index} variant {e.provenance.variant}: {e.dropped}" for e in made if e.dropped]
        if not new:
            first = [*failures, *dropped][0]
            raise EpisodeError(f"no episode could be augmented; nothing was written. First: {first}")
        output.finish(new, draccus.dump(config))
    report = write_report(source, new_root, made, [str(failure) for failure in failures], time.perf_counter() - start)
    rendered = sum(episode.provenance.variant != SOURCE_VARIANT for episode in new)
    sys.stdout.write(
        f"{len(episodes) - len(failures)} of {len(episodes)} episodes, {rendered} new ones "
        f"({config.variants} per episode, {', '.join(cameras)}), {time.perf_counter() - start:.0f} s\n"
        f"written to {new_root}\n"
        f"look at {report}\n"
        f"train:  lerobot-train --dataset.repo_id={new_repo_id} --dataset.root={new_root} --policy.type=act "
        "--policy.push_to_hub=false\n"
    )
    for failure in failures:
        sys.stdout.write(f"skipped: {failure}\n")
    for line in dropped:
        sys.stdout.write(f"dropped: {line}\n")
    return EXIT_SOME_EPISODES_FAILED if failures or dropped else EXIT_OK


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
