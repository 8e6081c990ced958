"""Who runs which episode: this process, or several on this machine."""

import contextlib
import functools
import logging
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from dataclasses import replace

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from tqdm.contrib.logging import logging_redirect_tqdm

from lerobot_msdyn.augment.assumed_depth import say_assumed_depth
from lerobot_msdyn.augment.backgrounds import background_episodes, background_worth
from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.augment.earlier_scenes import problems_of_scenes
from lerobot_msdyn.augment.episode import augment_episode
from lerobot_msdyn.augment.failures import same_reason
from lerobot_msdyn.augment.job import Opened
from lerobot_msdyn.augment.plan import camera_lines
from lerobot_msdyn.augment.progress import EpisodeBar
from lerobot_msdyn.augment.robot_cameras import calibrated
from lerobot_msdyn.augment.run_identity import source_folder
from lerobot_msdyn.augment.workers import Work, Workers, workers_for
from lerobot_msdyn.core.config import FIXED, Recipe
from lerobot_msdyn.core.errors import EpisodeError, MsdynError
from lerobot_msdyn.core.fields import AUTO
from lerobot_msdyn.dataset.convert import named_as_given
from lerobot_msdyn.dataset.provenance import CALIBRATION
from lerobot_msdyn.dataset.read import hand_on_nothing
from lerobot_msdyn.dataset.rows import files_problem
from lerobot_msdyn.dataset.staging import BACKGROUNDS
from lerobot_msdyn.dataset.write import NewEpisode, OutputDataset
from lerobot_msdyn.priors.estimate import check_named_providers
from lerobot_msdyn.render.devices import chosen_device

logger = logging.getLogger(__name__)


def prepared(opened: Opened, config: AugmentConfig, output: OutputDataset) -> tuple[AugmentConfig, dict[int, str]]:
    """What is found out once, before any work: the settings with where cameras stand, and what no file is there for.

    The second is why an episode cannot be read, by its number, as far as that is seen without opening its files.
    """
    chosen_device(config.device)  # complains, or says what is used, before anything is done
    check_named_providers(config.priors, config.camera, config.device)
    source, cameras = opened.source, opened.cameras
    problems = problems_of(source, opened.episodes, opened.rendered, cameras, config)
    if config.scenes is not None:
        return config, problems
    whole = [index for index in opened.episodes if index not in problems]
    if whole:
        config = calibrated(source, whole, cameras, config, output.staging.folder / CALIBRATION)
    _say_what_is_assumed(source, cameras, config)
    return config, problems


def problems_of(
    source: LeRobotDatasetMetadata,
    episodes: Sequence[int],
    rendered: Collection[int],
    cameras: Sequence[str],
    config: Recipe,
) -> dict[int, str]:
    """Why episodes cannot be read, or those to be rendered have no scenes where --scenes names some.

    As far as that is seen without opening the episodes' files.
    """
    files = {index: files_problem(source, index) for index in episodes}
    problems = {index: problem for index, problem in files.items() if problem}
    if config.scenes is None:
        return problems
    wanted = [index for index in episodes if index in rendered]
    return problems_of_scenes(source, wanted, cameras, config.scenes) | problems


def run_local(opened: Opened, config: AugmentConfig, output: OutputDataset) -> dict[int, str]:
    """Finish all episodes on this machine; returns why some failed: every reason is logged once."""
    source, episodes = opened.source, opened.episodes
    config, problems = prepared(opened, config, output)
    failures: dict[int, str] = {}
    reasons: set[str] = set()
    before = 0.0 if output.staging.has(BACKGROUNDS) else background_worth(source, config)
    count = len(opened.rendered)
    with logging_redirect_tqdm(), EpisodeBar(count, what="looking at the background", before=before) as bar:

        def progress(what: str, share: float) -> None:
            if what:
                bar.begin(what)
            bar.advance(share)

        work = Work(source, frozenset(opened.rendered), opened.cameras, config, output, progress)
        for index, failure in attempts(work, episodes, problems):
            if failure is None:
                continue
            failures[index] = named_as_given(failure, output.staging.folder, source_folder(config))
            reason = same_reason(source.repo_id, index, failures[index])
            if reason not in reasons:
                reasons.add(reason)
                logger.error("skipped: %s", failures[index])
        bar.advance(before + count)
    return failures


def share_background(work: Work) -> None:
    """Make what the episodes share of the background, by this process or, where that pays, by several."""
    looked_at = background_episodes(work.source, work.config)
    frames = sum(int(work.source.episodes[index]["length"]) for index in looked_at)
    count = workers_for(work.config, frames, len(looked_at))
    if count == 1:
        _ = work.backgrounds
        return
    workers = Workers(count, work)
    with workers:
        _ = replace(work, run=workers.moving).backgrounds


def attempts(work: Work, episodes: list[int], problems: Mapping[int, str]) -> Iterator[tuple[int, str | None]]:
    """Finish episodes: each with why that is not possible, or nothing, as it is done, in their order.

    `problems` are known reasons. Episodes are worked on by this process or, where that pays, by several.
    """
    whole = [index for index in episodes if index not in problems]
    with contextlib.closing(_attempts(work, whole)) as results:  # workers end before the lock is let go
        for index in episodes:
            yield index, problems[index] if index in problems else next(results)


def _attempts(work: Work, episodes: list[int]) -> Generator[str | None]:
    """Why each episode failed, or nothing; by this process or, where that pays, by several."""
    unfinished = [index for index in episodes if index in work.rendered and not work.output.is_finished(index)]
    frames = sum(int(work.source.episodes[index]["length"]) for index in unfinished)
    count = workers_for(work.config, frames, len(unfinished))
    if count == 1:
        for index in episodes:
            yield attempt(work, index)
        return
    logger.info("%d episodes at once (--workers)", count)
    workers = Workers(count, work)
    with workers:
        _ = replace(work, run=workers.moving).backgrounds  # before they are asked for by all at once
        hand_on_nothing(work.source)
        yield from workers.map(attempt, episodes)


def attempt(work: Work, index: int) -> str | None:
    """Finish one episode; returns why that is not possible."""
    make = _make(work, index)
    try:
        work.output.finish_episode(index, make)
    except EpisodeError as error:
        return str(error)
    except MsdynError:
        raise
    except torch.OutOfMemoryError:
        name = f"{work.source.repo_id} episode {index}"
        return f"{name}: the memory of the GPU is full; try fewer --workers, or a smaller --fit.max_width"
    except Exception as error:  # hours of other episodes' work must not be lost to a fault in one
        logger.exception("skipped episode %d: a fault of lerobot_msdyn, please report it", index)
        return f"{work.source.repo_id} episode {index}: {type(error).__name__}: {error}"
    return None


def _make(work: Work, index: int) -> Callable[[], list[NewEpisode]]:
    """What makes all new episodes of one."""
    return functools.partial(
        augment_episode,
        work.source,
        index,
        work.cameras if index in work.rendered else [],
        work.config,
        work.output,
        work.progress,
        work.backgrounds,
    )


def _say_what_is_assumed(source: LeRobotDatasetMetadata, cameras: list[str], config: AugmentConfig) -> None:
    """Once per run: what nobody measured."""
    if not cameras:
        return
    for line in camera_lines(source, cameras, config):
        logger.info("%s", line)
    if config.camera.calibration is None and config.camera.poses in (AUTO, FIXED) and not config.camera.pose_columns:
        logger.warning(
            "no calibration: cameras are taken as fixed, with a horizontal field of view of %g degrees "
            "(--camera.calibration FILE, --camera.horizontal_fov_deg)",
            config.camera.horizontal_fov_deg,
        )
    say_assumed_depth(source, cameras, config)
