"""The main job on a small synthetic dataset: write it, augment it, load the result with LeRobot, look at it.

make demo
"""

import shutil
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from lerobot.datasets import LeRobotDataset

OUT = Path("demo_out")
CAMERA = "observation.images.front"
COPIED = ("action", "observation.state", "timestamp", "frame_index", "task_index")


def run(*arguments: str) -> None:
    """Run a command of the package, showing it first."""
    print("\n$ python -m", " ".join(arguments), flush=True)
    subprocess.run([sys.executable, "-m", *arguments], check=True)


def picture(item: dict) -> np.ndarray:
    """A dataset item's image as bytes [h, w, 3]."""
    return (item[CAMERA].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)


def before_after(source: LeRobotDataset, output: LeRobotDataset, path: Path, columns: int = 4) -> None:
    """Recorded frames above, the same frames of the new episode below."""
    start = output.meta.episodes[1]["dataset_from_index"]  # episode 0 is the copy of the recorded one
    length = output.meta.episodes[1]["length"]
    frames = np.linspace(0.1 * length, 0.9 * length, columns).astype(int)
    rows = [
        np.concatenate([picture(source[int(i)]) for i in frames], axis=1),
        np.concatenate([picture(output[int(start + i)]) for i in frames], axis=1),
    ]
    cv2.imwrite(str(path), np.concatenate(rows)[..., ::-1])


def main() -> None:
    """Run the demo."""
    begin = time.perf_counter()
    shutil.rmtree(OUT, ignore_errors=True)
    size = ["--width", "320", "--height", "240"]
    run("lerobot_msdyn.synthetic", "--out", str(OUT / "desk"), "--kind", "push", "--episodes", "2", "--depth", *size)
    run("lerobot_msdyn.augment", "--repo", "local/desk", "--root", str(OUT / "desk"), "--recipe", "quick")

    source = LeRobotDataset("local/desk", root=OUT / "desk", video_backend="pyav")
    output = LeRobotDataset("local/desk_msdyn", root=OUT / "desk_msdyn", video_backend="pyav")
    recorded = source.meta.episodes["length"]
    origin = [episode for episode in range(len(recorded)) for _ in range(2)]  # each: its copy, then its new variant
    for new, old in enumerate(origin):
        first_new = output.meta.episodes[new]["dataset_from_index"]
        first_old = source.meta.episodes[old]["dataset_from_index"]
        for i in range(recorded[old]):
            a, b = source[first_old + i], output[first_new + i]
            if not all(torch.equal(a[key], b[key]) for key in COPIED):
                raise SystemExit(f"episode {new}, frame {i}: not the source's values")
    path = OUT / "before_after.png"
    before_after(source, output, path)
    print(f"\nLeRobot loads {OUT}/desk_msdyn: {output.num_episodes} episodes, {len(output)} frames, same actions.")
    print(f"before (top) and after (bottom): {path.resolve()}")
    print(f"{time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    main()
