"""Times every stage of an episode, and how time and memory grow.

    python benchmarks/pipeline.py [--recipe quick] [--steps N] [--long] [--json FILE]

Made-up scenes with recorded depth: a base case, and one run each with twice the frames, twice the width and height,
twice the variants, and three episodes. Stages: read, priors, initial scene, fit, render (holes filled, not encoded).
Every run is a process of its own, whose peak of resident memory is given; below it how many times the base case's
each figure is. `--long` reconstructs small videos of 300 and 3,000 frames instead: the bound on memory.
"""

import argparse
import json
import multiprocessing
import resource
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path

STAGES = ("shared background", "read", "priors", "initial scene", "fit", "render")


@dataclass(frozen=True)
class Case:
    """What is reconstructed."""

    name: str
    frames: int = 60
    width: int = 320
    height: int = 240
    variants: int = 2
    episodes: int = 1


BASE = Case("base")
CASES = (
    BASE,
    replace(BASE, name="frames x 2", frames=120),
    replace(BASE, name="size x 2", width=640, height=480),
    replace(BASE, name="variants x 2", variants=4),
    replace(BASE, name="episodes x 3", episodes=3),
)

LONG = (
    Case("300 frames", frames=300, width=64, height=48, variants=1),
    Case("3,000 frames", frames=3000, width=64, height=48, variants=1),
)


def timed(function: Callable, name: str, seconds: dict[str, float]) -> Callable:
    """The same function, whose time is added up under a name."""

    def wrapper(*arguments: object, **named: object) -> object:
        start = time.perf_counter()
        result = function(*arguments, **named)
        seconds[name] += time.perf_counter() - start
        return result

    return wrapper


def measure(case: Case, recipe_name: str, steps: int | None, pipe: Connection) -> None:
    """Send the seconds of every stage and the peak of resident memory (MB)."""
    from lerobot_msdyn import pipeline, views
    from lerobot_msdyn.bounds import new_cameras
    from lerobot_msdyn.cli import parse_config
    from lerobot_msdyn.config import AugmentConfig
    from lerobot_msdyn.episode import open_source
    from lerobot_msdyn.render.warmup import warm_up
    from lerobot_msdyn.sharing import shared_backgrounds
    from lerobot_msdyn.synthetic import make_scene
    from lerobot_msdyn.synthetic.dataset import write_dataset

    seconds: dict[str, float] = defaultdict(float)

    recipe = parse_config(AugmentConfig, ["--recipe", recipe_name], {}, command="benchmark")
    if steps is not None:
        recipe.fit.steps = steps
    warm_up([4])
    with tempfile.TemporaryDirectory() as folder:
        recipe.priors.cache = str(Path(folder) / "cache")  # of this run: masks are found again as in any run
        scenes = [
            make_scene("push", 0, case.frames, case.width, case.height, episode=index) for index in range(case.episodes)
        ]
        write_dataset(scenes, "local/bench", Path(folder) / "bench", cameras=["front"], depth=True)
        source = open_source("local/bench", Path(folder) / "bench")
        key = "observation.images.front"
        share = timed(shared_backgrounds, "shared background", seconds)
        read = timed(pipeline.read_episode, "read", seconds)
        render = timed(lambda scene, camera: list(views.new_pictures(scene, camera)), "render", seconds)
        backgrounds = share(source, [key], recipe)
        pipeline.estimate_priors = timed(pipeline.estimate_priors, "priors", seconds)
        pipeline.initialise = timed(pipeline.initialise, "initial scene", seconds)
        for index in range(case.episodes):
            view = read(source, index, [key], recipe.camera).views[key]
            scene = pipeline.reconstruct(view, recipe, backgrounds=backgrounds.get(key, []))
            seconds["fit"] += scene.seconds
            for variant in range(case.variants):
                render(scene, new_cameras({key: scene}, recipe, index, variant).cameras[key])
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
    pipe.send((dict(seconds), peak_mb))


def run(case: Case, recipe: str, steps: int | None) -> dict[str, float]:
    """One case in a process of its own: seconds by stage, in all, per new picture, and the peak of memory."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=measure, args=(case, recipe, steps, sender))
    process.start()
    sender.close()
    seconds, peak_mb = receiver.recv()
    process.join()
    return {name: seconds.get(name, 0.0) for name in STAGES} | {"all": sum(seconds.values()), "peak MB": peak_mb}


def growth(row: dict[str, float], base: dict[str, float], columns: tuple[str, ...]) -> str:
    """How many times the base case's each figure is."""
    return "".join(
        f"{row[name] / base[name]:{max(9, len(name) + 2)}.2f}" if base[name] > 0 else " " * max(9, len(name) + 2)
        for name in columns
    )


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipe", default="quick")
    parser.add_argument("--steps", type=int, help="of the fit; default: the recipe's")
    parser.add_argument("--long", action="store_true", help="300 and 3,000 frames instead")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = []
    columns = (*STAGES, "all", "peak MB")
    sys.stdout.write(f"{'seconds':14s}" + "".join(f"{name:>{max(9, len(name) + 2)}s}" for name in columns) + "\n")
    for case in LONG if options.long else CASES:
        row = run(case, options.recipe, options.steps)
        rows.append(asdict(case) | row)
        line = "".join(f"{row[name]:{max(9, len(name) + 2)}.1f}" for name in columns)
        sys.stdout.write(f"{case.name:14s}{line}\n")
        if len(rows) > 1:
            sys.stdout.write(f"{'  times base':14s}{growth(row, rows[0], columns)}\n")
        sys.stdout.flush()
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
