"""Processes that work on episodes beside each other, each on its share of the cores.

A worker writes to the work folder that its parent has locked, and ends with its parent, however that ends: it listens
at a pipe whose other end nobody else holds.
"""

import contextlib
import functools
import logging
import logging.handlers
import math
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cached_property
from multiprocessing.connection import Connection
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any

import cv2
import draccus
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from tqdm import tqdm

from lerobot_msdyn.augment.backgrounds import Backgrounds, MaskTask, Run, shared_backgrounds
from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.augment.episode import Progress
from lerobot_msdyn.core.errors import WorkerError
from lerobot_msdyn.core.plugins import import_plugins, imported_plugins
from lerobot_msdyn.dataset.read import open_source
from lerobot_msdyn.dataset.staging import Staging
from lerobot_msdyn.dataset.video import quiet_encoders
from lerobot_msdyn.dataset.write import OutputDataset
from lerobot_msdyn.render.devices import chosen_device

MEMORY_EACH = 3e9  # bytes of a machine's memory that there must be for each worker
GPU_MEMORY_EACH = 4e9  # bytes of a GPU's free memory; by arithmetic, not measured (docs/render.md)
FRAMES_EACH = 200  # of work, for which starting a worker pays


@dataclass(frozen=True)
class Work:
    """What a run works on, in any of its processes."""

    source: LeRobotDatasetMetadata
    cameras: list[str]
    config: AugmentConfig
    output: OutputDataset
    progress: Progress
    run: Run | None = None  # how the background's episodes are looked at; default: one after the other

    @cached_property
    def backgrounds(self) -> Backgrounds:
        """What the episodes share, made once per run."""

        def make() -> Backgrounds:
            return shared_backgrounds(self.source, self.cameras, self.config, self.run)

        backgrounds: Backgrounds = self.output.staging.keep("backgrounds", make)
        return backgrounds


@dataclass(frozen=True)
class _Place:
    """Where a worker finds what its parent works on.

    Plain values only: what is sent is read before any plugin is imported, from which the settings' types may be.
    """

    plugins: list[str]
    repo_id: str
    root: Path
    cameras: list[str]
    settings: dict[str, Any]
    new_repo_id: str
    new_root: Path


def _place_of(work: Work) -> _Place:
    source, output = work.source, work.output
    settings = draccus.encode(work.config)
    return _Place(imported_plugins(), source.repo_id, source.root, work.cameras, settings, output.repo_id, output.root)


def _config_at(place: _Place) -> AugmentConfig:
    import_plugins(place.plugins)
    config: AugmentConfig = draccus.decode(AugmentConfig, place.settings)
    return config


def workers_for(config: AugmentConfig, frames: int, episodes: int) -> int:
    """How many processes are worth while for so many frames of so many episodes."""
    room = min(_memory() // MEMORY_EACH, _room_on_gpu(config))
    wanted = config.workers or int(min(_cores(), room, frames // FRAMES_EACH))
    return max(1, min(wanted, episodes))


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


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _memory() -> int:
    """Bytes of the machine's memory."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0


def _room_on_gpu(config: AugmentConfig) -> float:
    """How many workers a GPU has memory for, where they render on one."""
    if chosen_device(config.device).type == "cpu":
        return math.inf
    return torch.cuda.mem_get_info()[0] // GPU_MEMORY_EACH


class Workers:
    """Some processes, started when they are first needed. Use as a context."""

    def __init__(self, count: int, work: Work) -> None:
        self.count = count
        context = multiprocessing.get_context("spawn")
        theirs, self._ours = context.Pipe(duplex=False)
        self._messages: Queue = context.Queue()
        self._listener = threading.Thread(target=_listen, args=(self._messages, work.progress), daemon=True)
        threads = _share_of_threads(count)
        self._pool = ProcessPoolExecutor(count, context, _begin, (_place_of(work), threads, theirs, self._messages))

    def __enter__(self) -> "Workers":
        self._listener.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self._ours.close()  # they end at once
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._ours.close()
        self._messages.put(None)
        self._listener.join()
        self._messages.close()

    def map[A, B](self, function: Callable[[Work, A], B], items: Iterable[A]) -> Iterator[B]:
        """What a function of a module makes of each item, in their order.

        Raises:
            WorkerError: a worker ended; what is finished is kept.
        """
        try:
            with _interrupts_held():  # also in the processes that are started here
                results = self._pool.map(functools.partial(_call, function), items)
            yield from results
        except BrokenProcessPool as error:
            raise WorkerError(
                f"one of {self.count} worker processes ended unexpectedly, most often for want of memory; what is "
                "finished is kept: the same command with --workers 1 goes on from there"
            ) from error

    def moving(
        self, function: Callable[[LeRobotDatasetMetadata, MaskTask], object], tasks: list[MaskTask]
    ) -> Iterator[object]:
        """The same for a function of the source."""
        return self.map(_with_source, [(function, task) for task in tasks])


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C reaches all processes of a terminal, but is the parent's to answer, once this is left."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_here: list[Work] = []  # that of this worker


def _begin(place: _Place, threads: int, parent: Connection, messages: Queue) -> None:
    """Make a new process a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    logging.basicConfig(level=logging.INFO, handlers=[logging.handlers.QueueHandler(messages)], force=True)
    for said_by_parent in (chosen_device, open_source):
        logging.getLogger(said_by_parent.__module__).setLevel(logging.ERROR)
    tqdm.set_lock(threading.RLock())  # its own is for several processes, and left behind by one that ends at once
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    quiet_encoders()
    config, source = _config_at(place), open_source(place.repo_id, place.root)
    staging = Staging(place.new_root, lock=False)
    output = OutputDataset(source, place.new_repo_id, place.new_root, staging, nvenc=config.nvenc)
    _here.append(Work(source, place.cameras, config, output, lambda what, share: messages.put((what, share))))


def _end_with(parent: Connection) -> None:
    with contextlib.suppress(EOFError, OSError):
        parent.recv()
    os._exit(1)


def _call[A, B](function: Callable[[Work, A], B], item: A) -> B:
    return function(_here[0], item)


def _with_source(work: Work, call: tuple[Callable[[LeRobotDatasetMetadata, MaskTask], object], MaskTask]) -> object:
    function, task = call
    return function(work.source, task)


def _listen(messages: Queue, progress: Progress) -> None:
    """Log here what workers log, and report their progress, until there is nothing more to come."""
    while (message := messages.get()) is not None:
        if isinstance(message, logging.LogRecord):
            logging.getLogger(message.name).handle(message)
        else:
            progress(*message)
