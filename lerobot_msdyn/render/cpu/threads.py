"""Runs one kernel on several threads at once.

Kernels release the GIL and take their work by tickets from a shared counter, so a plain Python thread pool drives
them. numba's own threading layers were not used: `omp` kills forked children (DataLoader workers), `workqueue`
aborts the process when two Python threads enter it, `tbb` is one more thing to install; and all three are
process-wide choices that a library should leave to its user. The number of threads is torch's (1 inside DataLoader
workers), or that which it had before `torch_on_one_thread`.
"""

import contextlib
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import ContextVar
from functools import cache, partial
from typing import Any

import numpy as np
import torch

POINTS_PER_TICKET = 4096  # of a kernel that takes points: a fixed size, so that sums do not depend on the threads

_threads: ContextVar[int | None] = ContextVar("threads", default=None)


@contextlib.contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Torch on one thread, kernels on as many as before.

    Thousands of small tensor operations are slower when torch spreads each over all cores, many times slower where
    other programs want these too: its threads wait for each other without letting go of their core.
    """
    before = torch.get_num_threads()
    token = _threads.set(threads())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _threads.reset(token)


def threads() -> int:
    """How many threads this process may use for something that runs for longer than a small tensor operation."""
    return _threads.get() or torch.get_num_threads()


@cache
def _pool() -> ThreadPoolExecutor:
    """Threads that help the calling one; each is started when it is first needed."""
    return ThreadPoolExecutor(max(1, (os.cpu_count() or 1) - 1), "rasterizer")


@cache
def _helpers(count: int) -> ThreadPoolExecutor:
    """So many threads that work beside the calling one."""
    return ThreadPoolExecutor(count, "helpers")


if hasattr(os, "register_at_fork"):
    for threads_of_parent in (_pool, _helpers):  # of which a forked child has none
        os.register_at_fork(after_in_child=threads_of_parent.cache_clear)


def run(kernel: Callable[..., None], items: int, *arguments: Any) -> None:
    """Call `kernel(tickets, *arguments)` on as many threads as torch uses and `items` tickets can feed."""
    tickets = np.zeros(1, np.int64)
    helpers = min(threads(), items) - 1
    futures = [_pool().submit(kernel, tickets, *arguments) for _ in range(helpers)]
    kernel(tickets, *arguments)
    for future in futures:
        if not future.cancel():  # one that never started has nothing left to do
            future.result()


def in_threads[A, B](
    function: Callable[[A], B],
    items: Iterable[A],
    at_once: int | None = None,
    stop: Callable[[], object] = lambda: None,
) -> Generator[B]:
    """What a function makes of each item, in their order, on as many threads as this process may use.

    Torch, NumPy, OpenCV and the kernels let others run while they compute; within the function each has one thread, or
    its share of the threads, if only so many items are worked on `at_once`. Few items are taken ahead of what is asked
    for, so that memory stays bounded. What is under way when nobody asks any more is waited for; `stop` is called then.
    """
    count = min(threads(), at_once or threads())
    share = threads() // count
    if count == 1:
        yield from map(function, items)
        return
    gradients, before = torch.is_grad_enabled(), torch.get_num_threads()
    torch.set_num_threads(1)  # what a thread that begins has from then on

    def call(item: A) -> B:
        with torch.set_grad_enabled(gradients):
            return function(item)

    waiting: deque[Future[B]] = deque()
    with ThreadPoolExecutor(count, "items", initializer=_threads.set, initargs=(share,)) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(call, item))
                if len(waiting) > count:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            stop()
            for future in waiting:
                future.cancel()
            torch.set_num_threads(before)


def each_on[A, B](device: torch.device, function: Callable[[A], B], items: Iterable[A]) -> Iterator[B]:
    """What a function of tensors on a device makes of each item: `in_threads`, or one by one on a GPU."""
    return in_threads(function, items) if device.type == "cpu" else map(function, items)


def begun[A, B](function: Callable[[A], B], items: Iterable[A], helpers: int) -> list[Callable[[], B]]:
    """Calls that each give what a function makes of an item; so many threads begin to work on them, in order.

    What none has begun when it is asked for is made then, by the thread that asks: best from the last one on.
    """

    def result_of(item: A, future: Future[B]) -> B:
        return function(item) if future.cancel() else future.result()

    return [partial(result_of, item, _helpers(helpers).submit(function, item)) for item in items]


def point_tickets(times: int, points: int) -> int:
    """Blocks of `POINTS_PER_TICKET` points, of all times of a batch."""
    return times * -(-points // POINTS_PER_TICKET)
