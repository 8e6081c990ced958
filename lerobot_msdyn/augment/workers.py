"""Processes that work on episodes beside each other, each on its share of the cores.

A worker writes to the work folder that its parent has locked, and ends with its parent, however that ends.
"""

import contextlib
import functools
import logging
import math
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import draccus
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from tqdm import tqdm

from lerobot_msdyn.augment.backgrounds import Backgrounds, Run, background_worth, seen_together
from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.augment.episode import Progress
from lerobot_msdyn.core.cli import quiet_libraries
from lerobot_msdyn.core.plugins import import_plugins, imported_plugins
from lerobot_msdyn.core.processes import Processes, cores
from lerobot_msdyn.dataset.read import open_source
from lerobot_msdyn.dataset.staging import BACKGROUNDS, Staging
from lerobot_msdyn.dataset.video import quiet_encoders
from lerobot_msdyn.dataset.write import OutputDataset
from lerobot_msdyn.render.devices import chosen_device

MEMORY_EACH = 3e9  # bytes of a machine's memory that there must be for each worker
GPU_MEMORY_EACH = 4e9  # bytes of a GPU's free memory; by arithmetic, not measured (docs/render.md)
FRAMES_EACH = 200  # of work, for which starting a worker pays
STAGES = ("priors", "robots", "motion", "reconstruction", "views")  # whose findings only --verbose shows


@dataclass(frozen=True)
class Work:
    """What a run works on, in any of its processes."""

    source: LeRobotDatasetMetadata
    rendered: frozenset[int]  # the episodes that get new ones
    cameras: list[str]
    config: AugmentConfig
    output: OutputDataset
    progress: Progress
    run: Run | None = None  # how the background's episodes are looked at; default: one after the other

    @cached_property
    def backgrounds(self) -> Backgrounds:
        """What the episodes share, made once per run."""

        def make() -> Backgrounds:
            worth = background_worth(self.source, self.config)
            return seen_together(
                self.source, self.cameras, self.config, self.run, lambda what, share: self.progress(what, share * worth)
            )

        backgrounds: Backgrounds = self.output.staging.keep(BACKGROUNDS, make)
        return backgrounds


@dataclass(frozen=True)
class _Place:
    """Where a worker finds what its parent works on.

    Plain values only: what is sent is read before any plugin is imported, from which the settings' types may be.
    """

    plugins: list[str]
    repo_id: str
    root: Path
    rendered: frozenset[int]
    cameras: list[str]
    settings: dict[str, Any]
    new_repo_id: str
    new_root: Path


def _place_of(work: Work) -> _Place:
    source, output = work.source, work.output
    settings = draccus.encode(work.config)
    return _Place(
        imported_plugins(),
        source.repo_id,
        source.root,
        work.rendered,
        work.cameras,
        settings,
        output.repo_id,
        output.root,
    )


def _config_at(place: _Place) -> AugmentConfig:
    import_plugins(place.plugins)
    config: AugmentConfig = draccus.decode(AugmentConfig, place.settings)
    return config


def workers_for(config: AugmentConfig, frames: int, episodes: int) -> int:
    """How many processes are worth while for so many frames of so many episodes."""
    wanted = config.workers or min(most_workers(config), frames // FRAMES_EACH)
    return max(1, min(wanted, episodes))


def most_workers(config: AugmentConfig) -> int:
    """How many processes this machine has cores and memory for, at least one."""
    return max(1, int(min(cores(), _memory() // MEMORY_EACH, _room_on_gpu(config))))


@contextlib.contextmanager
def threads_of_one(count: int) -> Iterator[None]:
    """This process on as many threads as each of some workers has."""
    threads = torch.get_num_threads()
    torch.set_num_threads(_share_of_threads(count))
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _share_of_threads(count: int) -> int:
    return max(1, torch.get_num_threads() // count)


def _memory() -> int:
    """Bytes of the machine's memory."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0


def _room_on_gpu(config: AugmentConfig) -> float:
    """How many workers a GPU has memory for, where they render on one."""
    if chosen_device(config.device).type == "cpu":
        return math.inf
    return torch.cuda.mem_get_info()[0] // GPU_MEMORY_EACH


class Workers(Processes[Work]):
    """Processes that work on episodes. Use as a context."""

    def __init__(self, count: int, work: Work) -> None:
        super().__init__(count, functools.partial(_begin, _place_of(work), _share_of_threads(count)), work.progress)

    def moving(self, function: Callable[[LeRobotDatasetMetadata, Any], object], tasks: list[Any]) -> Iterator[object]:
        """The same as `map` for a function of the source."""
        return self.map(_with_source, [(function, task) for task in tasks])


def _begin(place: _Place, threads: int, progress: Progress) -> Work:
    """Make a new process a worker."""
    for said_by_parent in (chosen_device, open_source):
        logging.getLogger(said_by_parent.__module__).setLevel(logging.ERROR)
    quiet_libraries()
    config = _config_at(place)
    for each in _talkative(config):
        each.setLevel(logging.WARNING)
    tqdm.set_lock(threading.RLock())  # its own is for several processes, and left behind by one that ends at once
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    quiet_encoders()
    source = open_source(place.repo_id, place.root, config.tolerance_s)
    staging = Staging(place.new_root, lock=False)
    output = OutputDataset(source, place.new_repo_id, place.new_root, staging, nvenc=config.nvenc)
    return Work(source, place.rendered, place.cameras, config, output, progress)


@contextlib.contextmanager
def terse(config: AugmentConfig) -> Iterator[None]:
    """Within, stages say only what is wrong, unless the settings ask for more."""
    loggers = _talkative(config)
    before = [each.level for each in loggers]
    for each in loggers:
        each.setLevel(logging.WARNING)
    try:
        yield
    finally:
        for each, level in zip(loggers, before, strict=True):
            each.setLevel(level)


def _talkative(config: AugmentConfig) -> list[logging.Logger]:
    """Loggers of the stages that are to say less."""
    return [] if config.verbose else [logging.getLogger(f"lerobot_msdyn.{name}") for name in STAGES]


def _with_source(work: Work, call: tuple[Callable[[LeRobotDatasetMetadata, Any], object], Any]) -> object:
    function, task = call
    return function(work.source, task)
