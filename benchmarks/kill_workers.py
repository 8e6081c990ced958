"""Kill a worker process at random moments, and see that its run ends at once, says why, and can go on.

python benchmarks/kill_workers.py [--kills 200] [--workers 2] [--seed 0]

The processes are those of `augment --workers`, with tasks that cost nothing but say much: most kills come while a
message is written. Every fifth kill is of the run itself. A run must end within `LIMIT_S` seconds, with one line and
exit code 2, and leave no process behind; the same command must go on from what is finished.
"""

import argparse
import collections
import contextlib
import json
import logging
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from lerobot_msdyn.core.processes import Processes

LIMIT_S = 5.0
WAIT_S = 60.0
TASKS = 60
MOMENTS_S = 1.0  # within which a kill comes, from the start of the processes on
PARENT_EVERY = 5
ENDED = "worker processes ended unexpectedly"


def begin(tell: Callable[..., None]) -> Callable[..., None]:
    """What the tasks work with."""
    return tell


def task(tell: Callable[..., None], place: tuple[str, int]) -> bytes:
    """Finish one file, and talk meanwhile."""
    folder, number = place
    path = Path(folder) / str(number)
    if not path.exists():
        for _ in range(20):
            logging.getLogger("task").info("x" * random.randrange(300_000))
            tell("share", 0.05)
        part = path.with_suffix(".part")
        part.write_text("done")
        part.replace(path)
    return bytes(100_000)


def run(folder: str, count: int) -> int:
    """The run that is killed."""
    from lerobot_msdyn.core.cli import run_command

    def work(_: list[str]) -> int:
        with Processes(count, begin) as workers:
            return len(list(workers.map(task, [(folder, number) for number in range(TASKS)]))) - TASKS

    logging.basicConfig(level=logging.WARNING)
    run_command(work, [])
    return 1


def workers_of(process: int) -> list[int]:
    """The worker processes of a run."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == process and b"spawn_main" in (path / "cmdline").read_bytes():
                found.append(int(path.name))
        except (OSError, IndexError):
            continue
    return found


def alive(process: int) -> bool:
    """Whether a process still runs; one that has ended may wait to be reaped."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def trial(folder: Path, count: int, rng: random.Random, *, parent: bool) -> tuple[str, float, list[str]]:
    """One kill: what came of it, the seconds until all had ended, and what was wrong."""
    before = {path.name for path in folder.iterdir() if path.suffix == ""}
    command = [sys.executable, __file__, "--run", str(folder), "--workers", str(count)]
    started = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    begun = time.monotonic()
    workers: list[int] = []
    while len(workers) < count and started.poll() is None and time.monotonic() - begun < WAIT_S:
        time.sleep(0.01)
        workers = workers_of(started.pid)
    time.sleep(rng.uniform(0, MOMENTS_S))
    with contextlib.suppress(ProcessLookupError, IndexError):  # the run has ended by itself
        os.kill(started.pid if parent else rng.choice(workers), signal.SIGKILL)
    killed = time.monotonic()
    faults = []
    try:
        text = started.communicate(timeout=WAIT_S)[1]
    except subprocess.TimeoutExpired:
        started.kill()
        text = started.communicate()[1]
        faults.append("hangs")
    while any(map(alive, workers)) and time.monotonic() - killed < WAIT_S:
        time.sleep(0.01)
    seconds = time.monotonic() - killed
    code = started.returncode
    outcome = "finished" if code == 0 else "run killed" if code == -signal.SIGKILL else "worker killed"
    if seconds > LIMIT_S:
        faults.append(f"{seconds:.1f} s until all had ended")
    if outcome == "worker killed" and (code != 2 or text.count("error: ") != 1 or ENDED not in text):
        faults.append(f"exit code {code}: {text[-500:]}")
    if "Traceback" in text and outcome != "run killed":
        faults.append(f"traceback: {text[-1500:]}")
    if before - {path.name for path in folder.iterdir()}:
        faults.append("what was finished is lost")
    return outcome, seconds, faults


def main() -> int:
    """Print a summary; 0 if nothing went wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--run", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.run:
        return run(options.run, options.workers)
    rng = random.Random(options.seed)
    outcomes: collections.Counter[str] = collections.Counter()
    longest, bad = 0.0, 0
    folder = Path(tempfile.mkdtemp(prefix="msdyn_kill_"))
    while outcomes["worker killed"] + outcomes["run killed"] < options.kills:
        parent = sum(outcomes.values()) % PARENT_EVERY == PARENT_EVERY - 1
        outcome, seconds, faults = trial(folder, options.workers, rng, parent=parent)
        outcomes[outcome] += 1
        longest = max(longest, seconds if outcome != "finished" else 0.0)
        bad += bool(faults)
        for fault in faults:
            print(f"{sum(outcomes.values())}: {outcome}: {fault}", flush=True)
        if outcome == "finished":
            shutil.rmtree(folder)
            folder.mkdir()
    shutil.rmtree(folder)
    print(json.dumps({**outcomes, "longest_s": round(longest, 2), "bad": bad}))
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
