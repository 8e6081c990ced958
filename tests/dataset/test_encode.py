"""Pictures are encoded in order, beside what renders them, and a fault on either side ends both."""

import threading
from collections.abc import Iterator

import pytest

from lerobot_msdyn.core.errors import OutputError
from lerobot_msdyn.dataset import encode


def test_work_is_done_in_order_in_another_thread() -> None:
    done, threads = [], set()

    def work(item: int) -> None:
        done.append(item)
        threads.add(threading.get_ident())

    assert encode._meanwhile(work, iter(range(50))) == 50
    assert done == list(range(50))
    assert len(threads) == 1
    assert threads != {threading.get_ident()}
    assert encode._meanwhile(work, []) == 0


def test_only_so_many_are_made_ahead() -> None:
    made, release = [], threading.Event()

    def wait(item: int) -> None:
        release.wait(30)

    def items() -> Iterator[int]:
        for item in range(encode.AHEAD + 5):
            made.append(item)
            if item == encode.AHEAD:
                threading.Timer(0.2, release.set).start()
            assert item <= encode.AHEAD or release.is_set()
            yield item

    assert encode._meanwhile(wait, items()) == encode.AHEAD + 5


def test_a_fault_of_the_work_is_raised() -> None:
    def work(item: int) -> None:
        if item == 3:
            raise OutputError("the disk is full")

    with pytest.raises(OutputError, match="the disk is full"):
        encode._meanwhile(work, iter(range(1000)))


def test_a_fault_of_the_rendering_is_raised_when_the_work_is_done() -> None:
    done: list[int] = []

    def items() -> Iterator[int]:
        yield 1
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        encode._meanwhile(done.append, items())
    assert done == [1]
