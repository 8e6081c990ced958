"""What worker processes are given in tests; nothing heavy is imported."""

import logging
import os
import signal
import struct
import time
from collections.abc import Callable

from lerobot_msdyn.core.errors import OutputError

State = tuple[str, Callable[..., None]]


def begin(tell: Callable[..., None]) -> State:
    """What the tasks work with."""
    return "ready", tell


def broken_begin(tell: Callable[..., None]) -> State:
    """A worker that cannot begin."""
    raise OutputError("no place")


def double(state: State, number: int) -> int:
    """Twice the number, told and logged; later numbers are done sooner."""
    time.sleep(0.02 * max(0, 5 - number))
    logging.getLogger("tasks").info("%s: %d", state[0], number)
    state[1]("doubled", number)
    return 2 * number


def fail(_: State, kind: str) -> None:
    """An error that is expected, one that is not, and one that cannot be sent."""
    if kind == "expected":
        raise OutputError("disk full")
    if kind == "unexpected":
        raise ValueError("a fault")
    error = ValueError("cannot be sent")
    error.lock = lambda: None  # type: ignore[attr-defined]
    raise error


def babble(state: State, number: int) -> bytes:
    """Much for a pipe."""
    for _ in range(1000):
        logging.getLogger("tasks").info("x" * 100_000)
        state[1](number)
    return bytes(100_000)


def die_in_the_middle_of_a_message(state: State, number: int) -> None:
    """Killed after half of what it says is written."""
    if number == 1:
        os.write(state[1].func.__self__._pipe.fileno(), struct.pack("!i", 1000) + b"half")  # type: ignore[attr-defined]
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(60)
