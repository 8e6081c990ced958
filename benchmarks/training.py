"""Samples per second that a training loop is given: recorded, with views rendered on the fly, and from written ones.

    python benchmarks/training.py [--size 320x240] [--json FILE]

Makes a small dataset with LeRobot's own video settings, augments it with `--save_scenes true`, and reads random samples
through PyTorch's DataLoader as `lerobot-train` does. The three are measured in turn, a few batches each, over several
rounds; medians and, per number of workers, ratios to the recorded dataset are printed. Other processes on the machine
slow all three alike, so ratios mean more than rates.
"""

import argparse
import json
import logging
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset
from lerobot_msdyn.training import MixedViews

RECORDED, MIXED, WRITTEN = "recorded", "mixed views, p = {:g}", "written episodes"


def prepare(folder: Path, episodes: int, frames: int, width: int, height: int, steps: int) -> None:
    """A dataset, and the same with new episodes and saved scenes."""
    scenes = [make_scene("push", 0, frames, width, height, episode=index) for index in range(episodes)]
    write_dataset(scenes, "local/desk", folder / "desk")
    flags = {
        "variants": 1,
        "include_source": "false",
        "save_scenes": "true",
        "fit.steps": steps,
        "gate.enabled": "false",
    }
    command = [sys.executable, "-m", "lerobot_msdyn.augment", "--repo", "local/desk", "--root", str(folder / "desk")]
    subprocess.run([*command, *(f"--{name}={value}" for name, value in flags.items())], check=True)


def endless(dataset: torch.utils.data.Dataset, workers: int, batch_size: int) -> Iterator[dict]:
    """Batches in random order, from workers that stay."""
    loader = torch.utils.data.DataLoader(
        dataset,
        batch_size,
        shuffle=True,
        num_workers=workers,
        persistent_workers=workers > 0,
        multiprocessing_context="spawn" if workers else None,  # as lerobot-train does
        drop_last=True,
    )
    while True:
        yield from loader


def measure(datasets: dict[str, torch.utils.data.Dataset], workers: int, rounds: int, batches: int) -> dict[str, float]:
    """Median samples per second of each dataset, measured in turn."""
    batch_size = 8
    loaders = {name: endless(dataset, workers, batch_size) for name, dataset in datasets.items()}
    rates: dict[str, list[float]] = {name: [] for name in datasets}
    for _ in range(rounds + 1):
        for name, loader in loaders.items():
            for _ in range(2 * workers):  # what was read ahead while the others were measured
                next(loader)
            start = time.perf_counter()
            for _ in range(batches):
                next(loader)
            rates[name].append(batches * batch_size / (time.perf_counter() - start))
    return {name: statistics.median(values[1:]) for name, values in rates.items()}


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="320x240")
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--fit_steps", type=int, default=50)
    parser.add_argument("--probability", type=float, default=0.5)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--batches", type=int, default=6)
    parser.add_argument("--data", type=Path, help="keep the datasets here, and use them if they are there already")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    logging.disable(logging.WARNING)
    width, height = (int(side) for side in arguments.size.split("x"))
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.data or Path(temporary)
        if not (folder / "desk_msdyn").is_dir():
            prepare(folder, arguments.episodes, arguments.frames, width, height, arguments.fit_steps)
        recorded, written = (
            LeRobotDataset(f"local/{name}", root=folder / name, return_uint8=True) for name in ("desk", "desk_msdyn")
        )
        mixed = MixedViews(recorded, folder / "desk_msdyn", arguments.probability)
        datasets = {RECORDED: recorded, MIXED.format(arguments.probability): mixed, WRITTEN: written}
        rows = []
        for workers in arguments.workers:
            rates = measure(datasets, workers, arguments.rounds, arguments.batches)
            for name, rate in rates.items():
                ratio = rate / rates[RECORDED]
                rows.append({"dataset": name, "workers": workers, "samples_per_s": rate, "of_recorded": ratio})
                print(f"{workers} workers  {name:24s} {rate:7.1f} samples/s  {ratio:5.2f} of recorded", flush=True)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
