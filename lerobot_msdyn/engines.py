"""Who runs which episode: this process, one after the other or several at the same time."""

import functools
import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from lerobot_msdyn.config import AugmentConfig
from lerobot_msdyn.devices import chosen_device
from lerobot_msdyn.episode import depth_key_of
from lerobot_msdyn.errors import EpisodeError, MsdynError
from lerobot_msdyn.estimate import measure_speeds, predicted_seconds
from lerobot_msdyn.pipeline import augment_episode
from lerobot_msdyn.sharing import shared_backgrounds
from lerobot_msdyn.video import quiet_encoders
from lerobot_msdyn.write import NewEpisode, OutputDataset

logger = logging.getLogger(__name__)


def run_local(
    source: LeRobotDatasetMetadata,
    episodes: list[int],
    cameras: list[str],
    config: AugmentConfig,
    output: OutputDataset,
) -> tuple[list[NewEpisode], list[EpisodeError]]:
    """All episodes in this process; an episode that cannot be read is reported and left out."""
    chosen_device(config.device)  # complains, or says what is used, before anything is done
    quiet_encoders()
    _say_what_is_assumed(source, cameras, config)
    bar_format = "{desc} |{bar}| {percentage:3.0f} % of {total} episodes [{elapsed}<{remaining}]"
    with logging_redirect_tqdm(), tqdm(total=len(episodes), bar_format=bar_format) as shown:
        bar = _Bar(shown, len(episodes))
        bar.add("looking at the background", 0.0)
        backgrounds = output.staging.keep("backgrounds", lambda: shared_backgrounds(source, cameras, config))

        def attempt(index: int) -> list[NewEpisode] | EpisodeError:
            share = _Share(bar)
            make = functools.partial(augment_episode, source, index, cameras, config, output, share.add, backgrounds)
            found = _attempt(f"{source.repo_id} episode {index}", lambda: output.finish_episode(index, make))
            share.finish()
            return found

        results = _in_threads(attempt, episodes, config.episodes_at_once, bar)
    failures = [found for found in results if isinstance(found, EpisodeError)]
    return [new for found in results if not isinstance(found, EpisodeError) for new in found], failures


def _attempt(name: str, make: Callable[[], list[NewEpisode]]) -> list[NewEpisode] | EpisodeError:
    """What is made of an episode, or why it is left out; other faults that concern all episodes are raised."""
    try:
        return make()
    except EpisodeError as error:
        logger.error("skipped: %s", error)
        return error
    except MsdynError:
        raise
    except torch.OutOfMemoryError:
        logger.error("skipped %s: the memory of the GPU is full", name)
        return EpisodeError(f"{name}: the memory of the GPU is full; lower --episodes_at_once or --fit.max_width")
    except Exception as error:  # hours of other episodes' work must not be lost to a fault in one
        logger.exception("skipped %s: a fault of lerobot_msdyn, please report it", name)
        return EpisodeError(f"{name}: {type(error).__name__}: {error}")


def _in_threads[T](work: Callable[[int], T], episodes: list[int], at_once: int, bar: "_Bar") -> list[T]:
    """The work done for every episode, for some at the same time; results in the order of the episodes.

    While one waits for a GPU, another one's tracks are followed and its videos encoded, which needs no lock of Python.
    """
    if at_once == 1:
        return [work(index) for index in episodes]
    threads = max(1, torch.get_num_threads() // at_once)  # of each; torch counts them by thread
    with ThreadPoolExecutor(at_once, "episode", torch.set_num_threads, (threads,)) as pool:
        futures = [pool.submit(work, index) for index in episodes]
        try:
            return [future.result() for future in futures]
        except BaseException:
            bar.stop.set()
            pool.shutdown(cancel_futures=True)
            raise


class _Bar:
    """A progress bar for several threads, by which they are stopped as well."""

    def __init__(self, shown: tqdm, episodes: int) -> None:
        self._shown, self._episodes = shown, episodes
        self._lock, self.stop = threading.Lock(), threading.Event()

    def add(self, what: str, share: float) -> None:
        """Say what is being done, and that a share of an episode is."""
        if self.stop.is_set():
            raise KeyboardInterrupt
        with self._lock:
            if what:
                self._shown.set_description_str(what)
            self._shown.update(min(share, self._episodes - self._shown.n))  # up to rounding


class _Share:
    """How much of one episode is done."""

    def __init__(self, bar: _Bar) -> None:
        self._bar, self._done = bar, 0.0

    def add(self, what: str, share: float) -> None:
        """A further share, 0..1."""
        self._done += share
        self._bar.add(what, share)

    def finish(self) -> None:
        """All that is left: of an episode that was skipped, or done by an earlier run."""
        self.add("", 1 - self._done)


def plan(source: LeRobotDatasetMetadata, episodes: list[int], cameras: list[str], config: AugmentConfig) -> str:
    """What a run would do: episodes, pictures, disk and time, the last by doing a little of it."""
    frames = sum(int(source.episodes[index]["length"]) for index in episodes)
    copies = config.variants + int(config.include_source)
    size = sum(file.stat().st_size for file in source.root.rglob("*") if file.is_file())
    disk = size * frames * copies / max(source.total_frames, 1)
    seconds = predicted_seconds(measure_speeds(source, episodes[0], cameras, config), source, episodes, config)
    return (
        f"{source.repo_id}: {len(episodes)} episodes, {frames} frames; re-rendering {', '.join(cameras)}\n"
        f"{config.variants} new per episode: {len(episodes) * copies} episodes, {frames * copies} frames, "
        f"{frames * config.variants * len(cameras)} new pictures\n"
        f"about {disk / 1e6:.0f} MB on disk, and about {seconds / 60:.1f} minutes on this machine, "
        "judging by a few frames and steps\n"
    )


def _say_what_is_assumed(source: LeRobotDatasetMetadata, cameras: list[str], config: AugmentConfig) -> None:
    """Once per run: what nobody measured."""
    logger.info("%s: re-rendering %s", source.repo_id, ", ".join(cameras))
    if config.camera.calibration is None:
        logger.warning(
            "no calibration: cameras are taken as fixed, with a horizontal field of view of %g degrees "
            "(--camera.calibration FILE, --camera.horizontal_fov_deg)",
            config.camera.horizontal_fov_deg,
        )
    if config.priors.depth == "auto" and not all(depth_key_of(source, key) for key in cameras):
        logger.warning(
            "no recorded depth: unless a learned model or several calibrated cameras supply it, scenes are built on a "
            "table plane seen from %g m at %g degrees (--camera.height_m, --camera.tilt_deg); keep the changes of view "
            "small",
            config.camera.height_m,
            config.camera.tilt_deg,
        )
