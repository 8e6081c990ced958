"""Command line: new viewpoints for every episode of a LeRobot dataset.

python -m lerobot_msdyn.augment --repo local/ds
"""

import logging
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_msdyn.augment.config import ESSENTIALS, AugmentConfig
from lerobot_msdyn.core.cli import EXIT_INTERRUPTED, EXIT_OK, EXIT_SOME_EPISODES_FAILED, parse_config, run_command
from lerobot_msdyn.core.errors import ConfigError, DatasetError, EpisodeError, MsdynError

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

    from lerobot_msdyn.dataset.staging import Staging

logger = logging.getLogger(__name__)

COMMAND = "python -m lerobot_msdyn.augment"
ALIASES = {"repo": "repo_id"}


def run(arguments: list[str]) -> int:
    """Augment a dataset; returns the exit code."""
    config = parse_config(AugmentConfig, arguments, ALIASES, command=COMMAND, essentials=ESSENTIALS)
    if not config.repo_id:
        raise ConfigError(f"which dataset? {COMMAND} --repo NAME [--root FOLDER] (see --help)")
    # LeRobot and torch take seconds to import: only now, so that --help and bad flags are answered at once.
    from lerobot.utils.constants import HF_LEROBOT_HOME

    from lerobot_msdyn.augment.run_identity import source_folder
    from lerobot_msdyn.dataset.convert import named_as_given
    from lerobot_msdyn.dataset.staging import Staging, published_before
    from lerobot_msdyn.dataset.video import quiet_encoders
    from lerobot_msdyn.dataset.write import check_name, check_place

    quiet_encoders()
    root = source_folder(config)
    new_repo_id = config.new_repo_id or f"{config.repo_id}_msdyn"
    if config.new_repo_id is not None:
        check_name(config.new_repo_id)
    new_root = config.new_root
    if new_root is None and config.root is not None and config.new_repo_id is None:
        new_root = config.root.with_name(f"{config.root.name}_msdyn")
    new_root = new_root or HF_LEROBOT_HOME / new_repo_id
    left_out = published_before(new_root)
    if left_out is not None or _is_finished(config, root, new_root):
        done = f"finished before: written to {new_root}; its report.html says what was left out. Remove it to run again"
        sys.stdout.write("".join(f"{line}\n" for line in [done, *(left_out or [])]))
        return EXIT_OK
    check_place(root, new_root)
    opened = None if config.convert else _open(config, config.root)
    if opened is not None and config.dry_run:
        return _say_plan(config, *opened, new_root)
    staging = Staging(new_root)
    try:
        with staging:
            if opened is None:
                opened = _convert(config, root, staging)
                if config.dry_run:
                    return _say_plan(config, *opened, new_root)
            return augment(config, *opened, new_repo_id, new_root, staging)
    except MsdynError as error:  # a converted copy is gone when its name is read
        raise type(error)(named_as_given(str(error), staging.folder, root)) from error
    except KeyboardInterrupt:
        kept = staging.kept()
        if kept:
            kept = f"kept in {staging.folder}: {kept}; the same command goes on from there"
        sys.stderr.write(f"interrupted: {kept or 'nothing was finished yet, and nothing is kept'}\n")
        return EXIT_INTERRUPTED


def _open(config: AugmentConfig, root: Path | None) -> tuple["LeRobotDatasetMetadata", list[int], list[str]]:
    """The source, its episodes and its cameras."""
    from lerobot_msdyn.augment.moving_cameras import cameras_off_the_gripper, still_cameras
    from lerobot_msdyn.dataset.read import open_source
    from lerobot_msdyn.dataset.select import select_cameras, select_episodes

    source = open_source(config.repo_id, root, config.tolerance_s)
    episodes = select_episodes(source, config.episodes)
    cameras = select_cameras(source, config.cameras, allow_moving=config.allow_moving)
    if config.allow_moving:
        cameras = cameras_off_the_gripper(source, cameras, config)
    else:
        cameras = still_cameras(source, episodes, cameras, config)
    return source, episodes, cameras


def _is_finished(config: AugmentConfig, root: Path, new_root: Path) -> bool:
    """Whether the dataset in the output's place is what this command makes."""
    from lerobot_msdyn.dataset.provenance import read_provenance
    from lerobot_msdyn.dataset.staging import digest_of_run

    try:
        runs = {row.get("run") for row in read_provenance(new_root) or []}
        return len(runs) == 1 and runs == {digest_of_run(_describe(config, root))}
    except (DatasetError, OSError):  # nothing to compare: `check_place` says what is there
        return False


def _describe(config: AugmentConfig, root: Path) -> dict[str, Any]:
    """What the result of the command depends on."""
    from lerobot_msdyn.augment.run_identity import all_files, describe_run
    from lerobot_msdyn.dataset.read import open_source
    from lerobot_msdyn.dataset.select import select_episodes

    if config.convert:
        return describe_run(root, all_files(root), config)
    source = open_source(config.repo_id, config.root)
    return _describe_opened(config, source, select_episodes(source, config.episodes))


def _describe_opened(config: AugmentConfig, source: "LeRobotDatasetMetadata", episodes: list[int]) -> dict[str, Any]:
    from lerobot_msdyn.augment.backgrounds import background_episodes
    from lerobot_msdyn.augment.robot_cameras import calibration_episodes
    from lerobot_msdyn.augment.run_identity import describe_run, source_files

    read = [*episodes, *background_episodes(source, config), *calibration_episodes(source, config)]
    return describe_run(source.root, source_files(source, read), config)


def _convert(
    config: AugmentConfig, root: Path, staging: "Staging"
) -> tuple["LeRobotDatasetMetadata", list[int], list[str]]:
    """The same of a converted copy in the work folder."""
    from lerobot_msdyn.dataset.convert import converted_copy

    staging.agree(_describe(config, root), restart=config.restart)
    return _open(config, converted_copy(config.repo_id, root, staging.folder))


def augment(
    config: AugmentConfig,
    source: "LeRobotDatasetMetadata",
    episodes: list[int],
    cameras: list[str],
    new_repo_id: str,
    new_root: Path,
    staging: "Staging",
) -> int:
    """Run the job that the command line described and say how it went; returns the exit code."""
    from lerobot_msdyn.augment.cost import check_disk
    from lerobot_msdyn.augment.failures import one_line_each
    from lerobot_msdyn.augment.report.build import entries_of, write_report
    from lerobot_msdyn.augment.report.page import accounts_of
    from lerobot_msdyn.augment.robot_cameras import publish
    from lerobot_msdyn.augment.run import run_local
    from lerobot_msdyn.augment.run_identity import recipe_text
    from lerobot_msdyn.augment.workers import terse
    from lerobot_msdyn.dataset.provenance import CALIBRATION, FOLDER, SOURCE_VARIANT
    from lerobot_msdyn.dataset.training_command import training_command
    from lerobot_msdyn.dataset.write import OutputDataset
    from lerobot_msdyn.reconstruction.account import account_line
    from lerobot_msdyn.views.camera_change import units_of_shifts

    start = time.perf_counter()
    if not config.convert:
        staging.agree(_describe_opened(config, source, episodes), restart=config.restart)
    check_disk(source, episodes, config, staging.folder)
    with OutputDataset(source, new_repo_id, new_root, staging, nvenc=config.nvenc) as output:
        output.check(cameras, depth=config.render_depth)
        with terse(config):
            made, failures = run_local(source, episodes, cameras, config, output)
        new = [episode for episode in made if not episode.dropped]
        skipped = one_line_each(source.repo_id, failures) + _lost(config, source)
        dropped = [f"episode {e.source_index} variant {e.provenance.variant}: {e.dropped}" for e in made if e.dropped]
        left_out = [f"skipped: {line}" for line in skipped] + [f"dropped: {line}" for line in dropped]
        if not cameras:
            left_out.append("no new views: no camera stands still, and the recorded episodes are copied as they are")
        if not new:
            first = [*skipped, *dropped][0]
            raise EpisodeError(f"no episode could be augmented; nothing was written. First: {first}")

        def report(folder: Path) -> Path:
            publish(staging.folder / CALIBRATION, folder / FOLDER / CALIBRATION)
            seconds = time.perf_counter() - start
            return write_report(source, folder, new_root.name, made, skipped, len(failures), seconds)

        output.finish(new, recipe_text(config), left_out, report)
    accounts = accounts_of(entries_of(made)[0])
    rendered = sum(episode.provenance.variant != SOURCE_VARIANT for episode in new)
    of_cameras = f" ({config.variants} per episode, {', '.join(cameras)})" if cameras else ""
    return _say_skipped(
        f"{len(episodes) - len(failures)} of {len(episodes)} episodes, {rendered} new ones{of_cameras}, "
        f"{time.perf_counter() - start:.0f} s\n"
        f"{''.join(f'{camera}: {account_line(account)}{chr(10)}' for camera, account in accounts.items())}"
        f"{units_of_shifts([episode.provenance.perturbation for episode in made])}"
        f"written to {new_root}\n"
        f"look at {new_root / 'report.html'}\n"
        f"train: {training_command(source, len(episodes) - len(failures), new_repo_id, new_root)}\n",
        left_out,
    )


def _lost(config: AugmentConfig, source: "LeRobotDatasetMetadata") -> list[str]:
    """The episodes that a killed recorder has not finished, in a line, where all were asked for."""
    from lerobot_msdyn.dataset.select import lost_episodes

    lost = lost_episodes(source)
    if config.episodes is not None or len(lost) == 0:
        return []
    which = f"{lost.start} to {lost.stop - 1}" if len(lost) > 1 else f"{lost.start}"
    return [f"{source.repo_id} episodes {which}: lost, meta/info.json lists them but they are not in meta/episodes"]


def _say_plan(
    config: AugmentConfig, source: "LeRobotDatasetMetadata", episodes: list[int], cameras: list[str], new_root: Path
) -> int:
    from lerobot_msdyn.augment.run import plan

    sys.stdout.write(plan(source, episodes, cameras, config) + f"would be written to {new_root}\n")
    return EXIT_OK


def _say_skipped(done: str, left_out: list[str]) -> int:
    sys.stdout.write(done + "".join(f"{line}\n" for line in left_out))
    return EXIT_SOME_EPISODES_FAILED if left_out else EXIT_OK


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
