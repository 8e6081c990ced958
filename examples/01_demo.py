"""The main job on one small synthetic episode: write it, augment it, load the result with LeRobot, look at it.

make demo              the episode has recorded depth
make demo-no-depth     it has colour alone, as a webcam gives it
"""

import argparse
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
RECORDED, NEW = 0, 1  # episodes of the output
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
    start, length = (output.meta.episodes[NEW][name] for name in ("dataset_from_index", "length"))
    frames = np.linspace(0.1 * length, 0.9 * length, columns).astype(int)
    rows = [
        np.concatenate([picture(source[int(i)]) for i in frames], axis=1),
        np.concatenate([picture(output[int(start + i)]) for i in frames], axis=1),
    ]
    cv2.imwrite(str(path), np.concatenate(rows)[..., ::-1])


def main() -> None:
    """Run the demo."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--no_depth", action="store_true", help="record colour alone")
    depth = [] if parser.parse_args().no_depth else ["--depth"]
    begin = time.perf_counter()
    shutil.rmtree(OUT, ignore_errors=True)
    size = ["--episodes", "1", "--frames", "40", "--width", "320", "--height", "240"]
    # What the first run on a machine compiles, on another core meanwhile.
    compiling = subprocess.Popen([sys.executable, "-m", "lerobot_msdyn.render.warmup"], stderr=subprocess.DEVNULL)
    run("lerobot_msdyn.synthetic", "--out", str(OUT / "desk"), "--kind", "push", *size, *depth)
    compiling.wait()
    run("lerobot_msdyn.augment", "--repo", "local/desk", "--root", str(OUT / "desk"), "--recipe", "quick")

    source = LeRobotDataset("local/desk", root=OUT / "desk", video_backend="pyav")
    output = LeRobotDataset("local/desk_msdyn", root=OUT / "desk_msdyn", video_backend="pyav")
    recorded, made = source.hf_dataset, output.hf_dataset  # the rows, without the videos
    for episode in (RECORDED, NEW):
        rows = made.select(range(episode * len(recorded), (episode + 1) * len(recorded)))
        if not all(torch.equal(torch.stack(rows[key][:]), torch.stack(recorded[key][:])) for key in COPIED):
            raise SystemExit(f"episode {episode}: not the source's values")
    path = OUT / "before_after.png"
    before_after(source, output, path)
    print(f"\nLeRobot loads {OUT}/desk_msdyn: {output.num_episodes} episodes, {len(output)} frames, same actions.")
    print(f"recorded (top) and new (bottom): {path.resolve()}")
    print(f"every new view and what to expect of it: {(OUT / 'desk_msdyn' / 'report.html').resolve()}")
    print(f"{time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    main()
