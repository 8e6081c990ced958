"""Processes that work on tasks beside each other, and end together, whichever of them is killed.

Each has a pipe of its own to its parent: no lock that a killed process could leave held, no queue that it could leave
half written. Where a process is gone, its end of the pipe is closed, and whoever reads or writes the other end is told.
"""

import contextlib
import functools
import logging
import logging.handlers
import multiprocessing
import os
import pickle
import queue
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from lerobot_msdyn.core.errors import MsdynError, WorkerError, first_line

IDLE, DONE, FAILED, LOGGED, SAID = "idle", "done", "failed", "logged", "said"  # what a worker tells its parent
END = b""  # what its parent tells a worker that is not needed any more
END_S = 10.0  # after which such a worker is killed


def cores() -> int:
    """Of this machine, that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Processes[S]:
    """Some worker processes, started when they are first needed. Use as a context; none is left behind."""

    def __init__(
        self, count: int, begin: Callable[[Callable[..., None]], S], said: Callable[..., object] = lambda *_: None
    ) -> None:
        """Describe the workers.

        Args:
            count: how many.
            begin: called in each with a function that tells its parent something; makes what its tasks work with.
                It can be pickled, and tasks and results as well.
            said: called here with what a worker tells.
        """
        self.count = count
        self._begin, self._said = pickle.dumps(begin), said
        self._workers: dict[Connection, BaseProcess] = {}
        self._idle: list[Connection] = []

    def __enter__(self) -> "Processes[S]":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for pipe, process in self._workers.items():
            if kind is None:
                with contextlib.suppress(OSError):
                    pipe.send_bytes(END)
            else:
                process.kill()
            pipe.close()
        for process in self._workers.values():
            process.join(END_S)
            process.kill()
            process.join()

    def map[A, B](self, function: Callable[[S, A], B], items: Iterable[A]) -> Iterator[B]:
        """What a function of a module makes of each item, in their order. One at a time, and to its end.

        What workers log is logged here, and what they tell is passed on, while a result is waited for.

        Raises:
            WorkerError: a worker ended.
            Exception: what the function raised first.
        """
        waiting = deque(enumerate(items))
        done: dict[int, B] = {}
        self._start()
        for number in range(len(waiting)):
            while number not in done:
                while self._idle and waiting:
                    place, item = waiting.popleft()
                    self._give(self._idle.pop(), (place, function, item))
                self._hear(done)
            yield done.pop(number)

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        with _interrupts_held():  # also in the processes that are started here
            while len(self._workers) < self.count:
                ours, theirs = context.Pipe()
                process = context.Process(target=_work, args=(theirs, self._begin))
                process.start()
                theirs.close()
                self._workers[ours] = process

    def _give(self, pipe: Connection, task: tuple[int, Callable, Any]) -> None:
        content = pickle.dumps(task)
        try:
            pipe.send_bytes(content)
        except OSError as error:
            raise self._ended(pipe) from error

    def _hear(self, done: dict[int, Any]) -> None:
        """Take one message of each worker that has sent some; waits for the first."""
        for pipe in wait(list(self._workers)):
            assert isinstance(pipe, Connection)
            try:
                kind, *content = pickle.loads(pipe.recv_bytes())
            except (EOFError, OSError) as error:
                raise self._ended(pipe) from error
            if kind == LOGGED:
                logging.getLogger(content[0].name).handle(content[0])
            elif kind == SAID:
                self._said(*content)
            elif kind == FAILED:
                raise content[0]
            else:
                self._idle.append(pipe)
                if kind == DONE:
                    done[content[0]] = content[1]

    def _ended(self, pipe: Connection) -> WorkerError:
        process = self._workers[pipe]
        process.join(1)
        code = process.exitcode
        how = f"exit code {code}" if code is None or code >= 0 else signal.Signals(-code).name
        return WorkerError(
            f"one of {self.count} worker processes ended unexpectedly ({how}), most often for want of memory; what is "
            "finished is kept: the same command goes on from there, with --workers 1 in less memory"
        )


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


class _Parent(logging.handlers.QueueHandler):
    """A worker's way to its parent, for any of its threads; takes log records as well."""

    def __init__(self, pipe: Connection) -> None:
        super().__init__(queue.Queue())  # never used
        self._pipe, self._sending = pipe, threading.Lock()

    def tell(self, kind: str, *content: object) -> None:
        message = pickle.dumps((kind, *content))
        try:
            with self._sending:
                self._pipe.send_bytes(message)
        except OSError:
            os._exit(1)  # it is gone

    def enqueue(self, record: logging.LogRecord) -> None:
        self.tell(LOGGED, record)

    def fail(self, error: Exception) -> None:
        """Tell of an error, or what can be told of it."""
        if not isinstance(error, MsdynError):
            error.add_note(f"In a worker process:\n{traceback.format_exc()}")
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            error = RuntimeError(f"{first_line(error)}\n{traceback.format_exc()}")
        self.tell(FAILED, error)


def _work(pipe: Connection, begin: bytes) -> None:
    """The life of a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tasks: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(pipe, tasks), daemon=True).start()  # before anything that takes long
    parent = _Parent(pipe)
    logging.root.setLevel(logging.INFO)
    logging.root.handlers = [parent]  # without a formatter: the parent has one
    try:
        state = pickle.loads(begin)(functools.partial(parent.tell, SAID))
        parent.tell(IDLE)
        while task := tasks.get():
            number, function, item = pickle.loads(task)
            parent.tell(DONE, number, function(state, item))
    except Exception as error:
        parent.fail(error)


def _read(pipe: Connection, tasks: "queue.SimpleQueue[bytes]") -> None:
    """Take tasks from the parent, and end with it."""
    task = None
    while task != END:
        try:
            task = pipe.recv_bytes()
        except (EOFError, OSError):
            os._exit(1)
        tasks.put(task)
