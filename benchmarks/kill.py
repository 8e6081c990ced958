"""Kill a run at random moments, go on each time, and compare with a run that nobody killed.

python benchmarks/kill.py --root ../shared/data/sim/pick_place_10/dataset --out /tmp/kill [--kills 20] [-- FLAGS]

The flags behind `--` are those of `lerobot_msdyn.augment`. Exit code 0: every kill came before the end of the run, and
nothing differs. Where the run ended first, ask for fewer kills or give it more to do.
"""

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import sys
import time
from pathlib import Path

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command does, before torch is loaded

# Imported once: the processes to kill are forked from this one, and spend their time on the work itself.
from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.augment import run_identity  # noqa: F401
from lerobot_msdyn.core.cli import run_command

BUDGET = ["--fit.steps=30", "--fit.max_width=96", "--scene.moving_gaussians=2000", "--scene.moving_frames=6"]


def fingerprint(root: Path) -> dict[str, str]:
    """A digest of every file of a dataset."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file() and path.name != "report.html"  # which says how long things took
    }


def start(source: Path, out: Path, flags: list[str], cache: Path, log: Path) -> int:
    """The run in a process of its own, with priors of its own; returns the process's number."""
    process = os.fork()
    if process:
        return process
    descriptor = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    for stream in (1, 2):
        os.dup2(descriptor, stream)
    os.environ["LEROBOT_MSDYN_CACHE"] = str(cache)
    names = ["--repo=local/killed", f"--root={source}", "--new_repo_id=local/killed_msdyn", f"--new_root={out}"]
    try:
        run_command(augment.run, [*names, *BUDGET, *flags])
    except SystemExit as end:
        os._exit(end.code if isinstance(end.code, int) else 1)
    finally:
        os._exit(1)


def ended(process: int, wait_s: float | None) -> int | None:
    """The exit code of a process; None if it still runs after a while, and is killed then."""
    begin = time.perf_counter()
    while wait_s is None or time.perf_counter() - begin < wait_s:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.05)
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return None


def main() -> int:
    """Print what differs; 0 if nothing does and all kills were made."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options, flags = parser.parse_known_args()
    flags = [flag for flag in flags if flag != "--"]
    shutil.rmtree(options.out, ignore_errors=True)
    options.out.mkdir(parents=True)
    whole, killed, log = options.out / "whole", options.out / "killed", options.out / "log"
    begin = time.perf_counter()
    if ended(start(options.root, whole, flags, options.out / "cache_whole", log), None) != 0:
        print(log.read_text()[-2000:])
        return 1
    duration = time.perf_counter() - begin
    rng = random.Random(options.seed)
    code: int | None = None
    moments: list[float] = []
    while code is None:
        process = start(options.root, killed, flags, options.out / "cache_killed", log)
        wait = rng.uniform(0.02, 1.0) * 2.5 * duration / options.kills if len(moments) < options.kills else None
        code = ended(process, wait)
        if code is None:
            moments.append(round(wait or 0, 1))
    a, b = fingerprint(whole), fingerprint(killed)
    differing = sorted(name for name in {*a, *b} if a.get(name) != b.get(name))
    left = sorted(path.name for path in options.out.iterdir() if path.name.startswith("."))
    report = {
        "uninterrupted_s": round(duration, 1),
        "killed_after_s": moments,
        "kills": len(moments),
        "kills_asked_for": options.kills,
        "exit_code": code,
        "files": len(a),
        "differing": differing,
        "left_behind": left,
    }
    print(json.dumps(report, indent=1))
    return int(bool(differing or left or code or len(moments) < max(1, options.kills)))


if __name__ == "__main__":
    sys.exit(main())
