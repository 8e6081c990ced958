"""Peak of resident memory of whole runs: by the number of episodes, and by their length.

    python benchmarks/memory.py [--episodes 2 8 24] [--frames 60 300 1000 3000] [--size 64x48] [--json FILE] [-- FLAGS]

One process works (`--workers=1`) on synthetic datasets with recorded depth: for each of `--episodes` that many of 12
frames, and for each of `--frames` one episode of that many. Every run of the command is a process of its own, which
begins with what its imports take (the first line). The flags behind `--` are those of `lerobot_msdyn.augment`; few
steps and Gaussians unless they say more.
"""

import argparse
import json
import logging
import multiprocessing
import os
import resource
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command does, before torch is loaded

# Imported once: every process is forked from this one, so that the imports are the same share of all figures.
from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.augment import run_identity  # noqa: F401
from lerobot_msdyn.augment.report import build  # noqa: F401
from lerobot_msdyn.core.cli import run_command
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset

SHORT = 12  # frames of the episodes of which there are several
BUDGET = ["--workers=1", "--variants=1", "--fit.steps=10", "--scene.moving_gaussians=500", "--scene.moving_frames=4"]
BUDGET += ["--gate.enabled=false"]  # so few steps of so small pictures may fail it
FORK = multiprocessing.get_context("fork")


@dataclass(frozen=True)
class Case:
    """What a run is given."""

    episodes: int
    frames: int  # of each episode


def peak_mb() -> float:
    """Peak of this process's resident memory."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def write(case: Case, width: int, height: int, root: Path) -> None:
    """The dataset of a case."""
    scenes = [make_scene("push", 0, case.frames, width, height, episode=index) for index in range(case.episodes)]
    write_dataset(scenes, "local/memory", root, cameras=["front"], depth=True)


def run(root: Path, flags: list[str], pipe: Connection) -> None:
    """Augment a dataset; send the exit code and the peak of memory."""
    os.environ["LEROBOT_MSDYN_CACHE"] = str(root.parent / "cache")
    code: object = None
    try:
        run_command(augment.run, ["--repo=local/memory", f"--root={root}", *BUDGET, *flags])
    except SystemExit as end:
        code = end.code
    pipe.send((code, peak_mb()))


def measured(case: Case, width: int, height: int, flags: list[str]) -> dict[str, object]:
    """The figures of one case."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "ds"
        writer = FORK.Process(target=write, args=(case, width, height, root))
        writer.start()
        writer.join()
        receive, send = FORK.Pipe(duplex=False)
        start = time.perf_counter()
        runner = FORK.Process(target=run, args=(root, flags, send))
        runner.start()
        code, peak = receive.recv()
        runner.join()
    return asdict(case) | {"exit_code": code, "peak_mb": round(peak), "seconds": round(time.perf_counter() - start)}


def main() -> int:
    """Print one line per case; 0 if all runs ended well."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, nargs="*", default=[2, 8, 24])
    parser.add_argument("--frames", type=int, nargs="*", default=[60, 300, 1000, 3000])
    parser.add_argument("--size", default="64x48")
    parser.add_argument("--json", type=Path)
    options, flags = parser.parse_known_args()
    flags = [flag for flag in flags if flag != "--"]
    width, height = map(int, options.size.split("x"))
    logging.disable(logging.INFO)
    print(f"imports alone: {peak_mb():.0f} MB", flush=True)
    rows = []
    for case in [Case(count, SHORT) for count in options.episodes] + [Case(1, count) for count in options.frames]:
        rows.append(measured(case, width, height, flags))
        print(", ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    if options.json is not None:
        options.json.write_text(
            json.dumps({"size": options.size, "imports_mb": round(peak_mb()), "runs": rows}, indent=1)
        )
    return int(any(row["exit_code"] != 0 for row in rows))


if __name__ == "__main__":
    sys.exit(main())
