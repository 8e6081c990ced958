"""The job around its episodes: what is opened before any of them, and how all of them become the output.

`run` works on the episodes. One process does all of it (`__main__`), or many do (the stage `cluster`).
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_msdyn.augment.backgrounds import background_episodes
from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.augment.cost import check_disk
from lerobot_msdyn.augment.failures import one_line_each, ranges
from lerobot_msdyn.augment.moving_cameras import cameras_off_the_gripper, still_cameras
from lerobot_msdyn.augment.report.build import entries_of, write_report
from lerobot_msdyn.augment.report.page import accounts_of
from lerobot_msdyn.augment.robot_cameras import calibration_episodes, publish
from lerobot_msdyn.augment.run_identity import all_files, describe_run, recipe_text, source_files
from lerobot_msdyn.augment.workers import terse
from lerobot_msdyn.core.errors import DatasetError, EpisodeError
from lerobot_msdyn.dataset.cover import covering_episodes
from lerobot_msdyn.dataset.pose_columns import check_pose_columns
from lerobot_msdyn.dataset.provenance import CALIBRATION, FOLDER, SOURCE_VARIANT, read_provenance
from lerobot_msdyn.dataset.read import open_source
from lerobot_msdyn.dataset.select import lost_episodes, select_cameras, select_episodes
from lerobot_msdyn.dataset.staging import Staging, digest_of_run, published_before
from lerobot_msdyn.dataset.training_command import training_command
from lerobot_msdyn.dataset.write import MadeEpisodes, OutputDataset, check_name
from lerobot_msdyn.reconstruction.account import account_line
from lerobot_msdyn.views.camera_change import units_of_shifts

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Opened:
    """A source, and what of it is worked on."""

    source: LeRobotDatasetMetadata
    episodes: list[int]
    rendered: list[int]  # those of them that get new episodes
    cameras: list[str]  # that are re-rendered


def open_job(config: AugmentConfig, root: Path | None) -> Opened:
    """The source, its episodes, and those of its cameras that are re-rendered: that stand still, or may move.

    Raises:
        ConfigError: `camera.pose_columns` names what the dataset does not have.
        DatasetError: there is no such dataset, episode or camera, or none that can be read.
    """
    source = open_source(config.repo_id, root, config.tolerance_s)
    episodes = select_episodes(source, config.episodes)
    cameras = select_cameras(source, config.cameras, allow_moving=config.allow_moving)
    check_pose_columns(source, config.camera)
    with terse(config):
        if config.allow_moving:
            cameras = cameras_off_the_gripper(source, cameras, config)
        else:
            cameras = still_cameras(source, episodes, cameras, config)
    episodes, rendered = chosen_episodes(source, config)
    if config.episodes_share < 1:
        logger.info(
            "new episodes of %d, chosen to cover what was recorded (--episodes_share): %s",
            len(rendered),
            ranges(rendered),
        )
    return Opened(source, episodes, rendered, cameras)


def chosen_episodes(source: LeRobotDatasetMetadata, config: AugmentConfig) -> tuple[list[int], list[int]]:
    """The episodes that are worked on, and those of them that get new ones; the others are written as recorded.

    Raises:
        DatasetError: one that is asked for is not there.
        EpisodeError: none can be read.
    """
    episodes = select_episodes(source, config.episodes)
    if config.episodes_share == 1:
        return episodes, episodes
    rendered = covering_episodes(source, episodes, config.episodes_share)
    return (episodes if config.include_source else rendered), rendered


def place_of(config: AugmentConfig) -> tuple[str, Path]:
    """The output's name and folder.

    Raises:
        OutputError: a dataset cannot have the name.
    """
    new_repo_id = config.new_repo_id or f"{config.repo_id}_msdyn"
    if config.new_repo_id is not None:
        check_name(config.new_repo_id)
    new_root = config.new_root
    if new_root is None and config.root is not None and config.new_repo_id is None:
        new_root = config.root.with_name(f"{config.root.name}_msdyn")
    return new_repo_id, new_root or HF_LEROBOT_HOME / new_repo_id


def finished_before(config: AugmentConfig, root: Path, new_root: Path) -> list[str] | None:
    """What to say where the dataset in the output's place is what this job makes of the source in `root`."""
    left_out = published_before(new_root)
    if left_out is None and not _is_finished(config, root, new_root):
        return None
    done = f"finished before: written to {new_root}; its report.html says what was left out. Remove it to run again"
    return [done, *(left_out or [])]


def _is_finished(config: AugmentConfig, root: Path, new_root: Path) -> bool:
    try:
        runs = {row.get("run") for row in read_provenance(new_root, ("run",)) or []}
        return len(runs) == 1 and runs == {digest_of_run(describe(config, root))}
    except (DatasetError, OSError):  # nothing to compare: `check_place` says what is there
        return False


def describe(config: AugmentConfig, root: Path) -> dict[str, Any]:
    """What the result of the job depends on."""
    if config.convert:
        return describe_run(root, all_files(root), config)
    return describe_opened(config, open_source(config.repo_id, config.root))


def describe_opened(config: AugmentConfig, source: LeRobotDatasetMetadata) -> dict[str, Any]:
    """The same of a source that is open."""
    files = source_files(source, files_of(config, source, select_episodes(source, config.episodes)))
    return describe_run(source.root, files, config)


def files_of(config: AugmentConfig, source: LeRobotDatasetMetadata, episodes: Sequence[int]) -> list[int]:
    """The episodes whose files work on some of them reads: they, and those that tell what all have in common."""
    return [*episodes, *background_episodes(source, config), *calibration_episodes(source, config)]


def checked_output(
    config: AugmentConfig,
    opened: Opened,
    new_repo_id: str,
    new_root: Path,
    staging: Staging,
    *,
    replaces: bool = False,
) -> OutputDataset:
    """The output in the making, where there is the disk for it and its videos can be encoded.

    `replaces`: an older state of it may lie in its place.

    Raises:
        OutputError: it cannot be made.
    """
    check_disk(opened.source, opened.episodes, opened.rendered, config, staging.folder)
    output = OutputDataset(opened.source, new_repo_id, new_root, staging, nvenc=config.nvenc, replaces=replaces)
    output.check(opened.cameras, depth=config.render_depth)
    return output


def deliver(
    config: AugmentConfig,
    opened: Opened,
    output: OutputDataset,
    failures: Mapping[int, str],
    seconds: Callable[[], float],
    *,
    keep_failed: bool = False,
) -> tuple[str, list[str]]:
    """Put the output together of all new episodes; returns how it went in words, and a line for each thing left out.

    Args:
        config: the settings.
        opened: what was worked on.
        output: the dataset that is made.
        failures: why source episodes are left out, by their numbers; the others are finished.
        seconds: how long the job has taken so far.
        keep_failed: whether the work folder stays where episodes failed, for a run that tries them again.

    Raises:
        EpisodeError: there is no new episode.
        OutputError: the disk is full, or the place was taken meanwhile.
    """
    source, cameras, new_root = opened.source, opened.cameras, output.root
    made, new = MadeEpisodes.of(output, [index for index in opened.episodes if index not in failures])
    skipped = one_line_each(source.repo_id, failures) + _lost(config, source)
    dropped = [f"episode {e.source_index} variant {e.provenance.variant}: {e.dropped}" for e in made if e.dropped]
    left_out = [f"skipped: {line}" for line in skipped] + [f"dropped: {line}" for line in dropped]
    if not cameras:
        left_out.append("no new views: no camera stands still, and the recorded episodes are copied as they are")
    if not new:
        first = [*skipped, *dropped][0]
        raise EpisodeError(f"no episode could be augmented; nothing was written. First: {first}")
    accounts = accounts_of(entry for entry, _ in entries_of(made))
    units = units_of_shifts([episode.provenance.perturbation for episode in made])
    rendered = sum(episode.provenance.variant != SOURCE_VARIANT for episode in new)

    def report(folder: Path) -> Path:
        publish(output.staging.folder / CALIBRATION, folder / FOLDER / CALIBRATION)
        return write_report(source, folder, new_root.name, made, skipped, len(failures), seconds())

    output.finish(new, recipe_text(config), left_out, report, keep=keep_failed and bool(failures))
    some = f"for each of {len(opened.rendered)} episodes" if config.episodes_share < 1 else "per episode"
    of_cameras = f" ({config.variants} {some}, {', '.join(cameras)})" if cameras else ""
    used = len(opened.episodes) - len(failures)
    text = (
        f"{used} of {len(opened.episodes)} episodes, {rendered} new ones{of_cameras}, {seconds():.0f} s\n"
        f"{''.join(f'{camera}: {account_line(account)}{chr(10)}' for camera, account in accounts.items())}"
        f"{units}written to {new_root}\n"
        f"look at {new_root / 'report.html'}\n"
        f"train: {training_command(source, used, output.repo_id, new_root)}\n"
    )
    return text, left_out


def _lost(config: AugmentConfig, source: LeRobotDatasetMetadata) -> list[str]:
    """The episodes that a killed recorder has not finished, in a line, where all were asked for."""
    lost = lost_episodes(source)
    if config.episodes is not None or len(lost) == 0:
        return []
    which = f"{lost.start} to {lost.stop - 1}" if len(lost) > 1 else f"{lost.start}"
    return [f"{source.repo_id} episodes {which}: lost, meta/info.json lists them but they are not in meta/episodes"]
