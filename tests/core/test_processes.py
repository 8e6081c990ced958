"""Worker processes: what they make, say and raise, and that all end where any is killed."""

import multiprocessing
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import worker_tasks as tasks

from lerobot_msdyn.core.errors import OutputError, WorkerError
from lerobot_msdyn.core.processes import Processes

TESTS = Path(__file__).parents[1]
PARENT = """
import worker_tasks as tasks
from lerobot_msdyn.core.processes import Processes

if __name__ == "__main__":
    with Processes(2, tasks.begin, print) as workers:
        list(workers.map(tasks.babble, range(100)))
"""


def test_results_come_in_order_and_what_is_said_comes_too(caplog: pytest.LogCaptureFixture) -> None:
    said: list[tuple[str, int]] = []
    with (
        caplog.at_level("INFO"),
        Processes(2, tasks.begin, lambda what, number: said.append((what, number))) as workers,
    ):
        assert list(workers.map(tasks.double, range(8))) == list(range(0, 16, 2))
        assert list(workers.map(tasks.double, [])) == []
        assert list(workers.map(tasks.double, [5])) == [10]
    assert sorted(said) == sorted([*(("doubled", number) for number in range(8)), ("doubled", 5)])
    assert caplog.messages.count("ready: 3") == 1
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize(
    ("kind", "error", "said"),
    [
        ("expected", OutputError, "disk full"),
        ("unexpected", ValueError, "a fault"),
        ("cannot be sent", RuntimeError, "ValueError: cannot be sent"),
    ],
)
def test_an_error_of_a_task_is_raised(kind: str, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said), Processes(1, tasks.begin) as workers:
        list(workers.map(tasks.fail, [kind]))
    assert multiprocessing.active_children() == []


def test_an_error_of_a_beginning_is_raised() -> None:
    with pytest.raises(OutputError, match="no place"), Processes(2, tasks.broken_begin) as workers:
        list(workers.map(tasks.double, [1]))


def test_a_worker_that_is_killed_while_it_writes() -> None:
    begun, said = time.monotonic(), r"one of 2 worker processes ended unexpectedly \(SIGKILL\)"
    with pytest.raises(WorkerError, match=said), Processes(2, tasks.begin) as workers:
        list(workers.map(tasks.die_in_the_middle_of_a_message, range(2)))
    assert time.monotonic() - begun < 30  # the other sleeps for longer
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("seed", range(4))
def test_a_worker_that_is_killed_at_a_random_moment(seed: int) -> None:
    rng = random.Random(seed)
    killed: list[float] = []

    def kill_one() -> None:
        while not multiprocessing.active_children():
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 1.0))
        os.kill(rng.choice(multiprocessing.active_children()).pid or 0, signal.SIGKILL)
        killed.append(time.monotonic())

    killer = threading.Thread(target=kill_one)
    killer.start()
    with pytest.raises(WorkerError, match="ended unexpectedly"), Processes(2, tasks.begin) as workers:
        list(workers.map(tasks.babble, range(1000)))
    assert time.monotonic() - killed[0] < 5
    assert multiprocessing.active_children() == []


def children_of(process: int) -> list[int]:
    """Numbers of the processes that it has started."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(path.read_text().rpartition(")")[2].split()[1]) == process:
                found.append(int(path.parent.name))
        except OSError:
            continue
    return found


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
def test_workers_end_with_their_parent(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(TESTS / "helpers"), str(TESTS.parent)])}
    parent = subprocess.Popen([sys.executable, script], env=environment, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    assert parent.stdout.readline()  # a worker has begun
    workers = children_of(parent.pid)
    assert len(workers) >= 2
    parent.kill()
    parent.stdout.close()
    parent.wait()
    deadline = time.monotonic() + 5
    while any(Path(f"/proc/{worker}").exists() for worker in workers):
        assert time.monotonic() < deadline
        time.sleep(0.05)
