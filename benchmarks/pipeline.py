"""Times every stage of an episode, and how time and memory grow.

    python benchmarks/pipeline.py [--recipe quick] [--steps N] [--small | --growth | --long | --so101 N] [--gate]

Synthetic scenes with recorded depth: a base case, and one run each with twice the frames, twice the width and height,
twice the variants, and three episodes. Stages: read, priors, initial scene, fit, render (holes filled, not encoded).
Every run is a process of its own, whose peak of resident memory is given; below it how many times the base case's
each figure is. `--small`: the same at half the size and half the frames. `--long` reconstructs small videos of 300 and
3,000 frames instead: the bound on memory. `--growth`: the base case of `--small`, and each of frames, pixels, variants
and episodes two and four times; below it the power of each by which processor time grows from two to four times.

`--so101 N`: N episodes as an SO-101's users have them, of 441 frames of 640x480, without depth, with a wrist camera
that is copied; rendering is with encoding. Below it the seams between windows: how much what stands still changes in
brightness and depth from the last frame of a window to the first of the next, and usually from frame to frame.

`--gate` ends with 1 where something grows more than in the committed pipeline.json by more than SLACK: how many times
the base case's the processor time of a stage, of all of them, or the memory is. Processor time hardly depends on what
else the machine does. The baseline is that of `--small --steps 40 --json benchmarks/pipeline.json`.
"""

import argparse
import json
import math
import multiprocessing
import os
import resource
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lerobot_msdyn.views.pictures import Picture

STAGES = ("shared background", "read", "priors", "initial scene", "fit", "render")  # further steps are left out
REST = "other steps"
MORE_STAGES = (REST, "copy")  # beside these, where a whole job is timed
BASELINE = Path(__file__).with_suffix(".json")
SLACK = 1.3  # a figure may grow by so many times what it grows by in the baseline
LINEAR = 1.1  # power up to which growth counts as linear
SHOWN = 0.05  # s of the base case, from which growth is shown
LEAST_S = 0.5  # of processor time in the base case, from which a stage is judged


@dataclass(frozen=True)
class Case:
    """What is reconstructed."""

    name: str
    frames: int = 60
    width: int = 320
    height: int = 240
    variants: int = 2
    episodes: int = 1
    whole: bool = False  # as a job has it: no depth, a wrist camera that is copied, new pictures encoded

    @property
    def stages(self) -> tuple[str, ...]:
        """Those that are shown."""
        return (*STAGES, *MORE_STAGES) if self.whole else STAGES


BASE = Case("base")
CASES = (
    BASE,
    replace(BASE, name="frames x 2", frames=120),
    replace(BASE, name="size x 2", width=640, height=480),
    replace(BASE, name="variants x 2", variants=4),
    replace(BASE, name="episodes x 3", episodes=3),
)

SMALL = tuple(replace(case, frames=case.frames // 2, width=case.width // 2, height=case.height // 2) for case in CASES)

AXES = ("frames", "pixels", "variants", "episodes")
GROWTH = (
    SMALL[0],
    *(
        replace(
            SMALL[0],
            name=f"{axis} x {times}",
            frames=SMALL[0].frames * (times if axis == "frames" else 1),
            width=round(SMALL[0].width * (times**0.5 if axis == "pixels" else 1)),
            height=round(SMALL[0].height * (times**0.5 if axis == "pixels" else 1)),
            variants=SMALL[0].variants * (times if axis == "variants" else 1),
            episodes=SMALL[0].episodes * (times if axis == "episodes" else 1),
        )
        for axis in AXES
        for times in (2, 4)
    ),
)

LONG = (
    Case("300 frames", frames=300, width=64, height=48, variants=1),
    Case("3,000 frames", frames=3000, width=64, height=48, variants=1),
)


def timed(function: Callable, name: str, seconds: dict[str, float]) -> Callable:
    """The same function, whose time is added up under a name, and its processor time under "cpu NAME"."""

    def wrapper(*arguments: object, **named: object) -> object:
        start, cpu = time.perf_counter(), time.process_time()
        result = function(*arguments, **named)
        seconds[name] += time.perf_counter() - start
        seconds[f"cpu {name}"] += time.process_time() - cpu
        return result

    return wrapper


def make(case: Case, root: Path) -> None:
    """Write the dataset of a case."""
    from lerobot_msdyn.synthetic import make_scene
    from lerobot_msdyn.synthetic.dataset import write_dataset

    scenes = [
        make_scene("push", 0, case.frames, case.width, case.height, episode=index) for index in range(case.episodes)
    ]
    cameras = ["front", "wrist"] if case.whole else ["front"]
    write_dataset(scenes, "local/bench", root, cameras=cameras, depth=not case.whole)


def measure(case: Case, root: Path, recipe_name: str, steps: int | None, pipe: Connection) -> None:
    """Send seconds and processor seconds of every stage, the peak of resident memory (MB), and seams in words."""
    from seams import seams

    from lerobot_msdyn.augment.backgrounds import shared_backgrounds
    from lerobot_msdyn.augment.config import AugmentConfig
    from lerobot_msdyn.augment.episode import by_feature
    from lerobot_msdyn.core.cli import parse_config
    from lerobot_msdyn.dataset.copy_source import stage_copies
    from lerobot_msdyn.dataset.encode import stage_pictures
    from lerobot_msdyn.dataset.read import open_source, read_episode
    from lerobot_msdyn.reconstruction.reconstruct import STEPS, reconstruct
    from lerobot_msdyn.render.devices import chosen_device
    from lerobot_msdyn.render.warmup import warm_up
    from lerobot_msdyn.views.new_cameras import new_cameras
    from lerobot_msdyn.views.pictures import for_many_views, new_pictures

    seconds: dict[str, float] = defaultdict(float)
    said: list[str] = []
    recipe = parse_config(AugmentConfig, ["--recipe", recipe_name], {}, command="benchmark")
    if steps is not None:
        recipe.fit.steps = steps
    warm_up([4])
    with tempfile.TemporaryDirectory() as folder:
        recipe.priors.cache = str(Path(folder) / "cache")  # of this run: masks are found again as in any run
        source = open_source("local/bench", root)
        key = "observation.images.front"
        share = timed(shared_backgrounds, "shared background", seconds)
        read = timed(read_episode, "read", seconds)
        copy = timed(stage_copies, "copy", seconds)
        rebuild = timed(reconstruct, "reconstruct", seconds)

        def rendered(pictures: Iterator["Picture"]) -> None:
            if case.whole:
                stage_pictures(source, Path(folder) / "new", by_feature(source, {key: pictures}), case.frames)
            else:
                list(pictures)

        render = timed(rendered, "render", seconds)
        backgrounds = share(source, [key], recipe)
        timed_steps = {name: timed(step, name, seconds) for name, step in STEPS.items()}
        for index in range(case.episodes):
            view = read(source, index, [key], recipe.camera).views[key]
            if case.whole:
                copy(source, index, source.camera_keys, Path(folder) / "copied")
            scene = rebuild(view, recipe, backgrounds=backgrounds.get(key, []), steps=timed_steps)
            scene = for_many_views(scene, chosen_device(recipe.device))
            for variant in range(case.variants):
                camera = new_cameras({key: scene}, recipe, index, variant).cameras[key]
                render(new_pictures(scene, camera, fill=recipe.fill))
                said += [f"episode {index}, variant {variant}, {seam}" for seam in seams(scene, camera, recipe.fill)]
    for prefix in ("", "cpu "):
        shown = sum(seconds[prefix + name] for name in STAGES if name in STEPS)
        seconds[prefix + REST] = seconds[prefix + "reconstruct"] - shown
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
    pipe.send((dict(seconds), peak_mb, said))


def run(case: Case, recipe: str, steps: int | None, data: Path | None) -> tuple[dict[str, float], list[str]]:
    """One case in a process of its own: (processor) seconds by stage and in all, and the peak of memory; its seams.

    The dataset is that in `data`, if it is there, else it is made, and kept in `data`, if that is given.
    """
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        root = data or Path(folder) / "bench"
        if not root.exists():
            maker = context.Process(target=make, args=(case, root))
            maker.start()
            maker.join()
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=measure, args=(case, root, recipe, steps, sender))
        process.start()
        sender.close()
        seconds, peak_mb, said = receiver.recv()
        process.join()
    by_stage = {prefix + name: seconds.get(prefix + name, 0.0) for prefix in ("", "cpu ") for name in case.stages}
    totals = {prefix + "all": sum(by_stage[prefix + name] for name in case.stages) for prefix in ("", "cpu ")}
    row = {name: round(value, 3) for name, value in (by_stage | totals | {"peak MB": peak_mb}).items()}
    return row, said


def growth(row: dict[str, float], base: dict[str, float], columns: tuple[str, ...]) -> str:
    """How many times the base case's each figure is."""
    return "".join(
        f"{row[name] / base[name]:{max(9, len(name) + 2)}.2f}" if base[name] > SHOWN else " " * max(9, len(name) + 2)
        for name in columns
    )


def powers(rows: list[dict]) -> list[str]:
    """The power of each axis by which processor time grows from two times the base case's to four times, in words."""
    lines = []
    for axis, twice, four_times in zip(AXES, rows[1::2], rows[2::2], strict=True):
        power = math.log2(four_times["cpu all"] / twice["cpu all"])
        verdict = "linear or less" if power < LINEAR else "MORE THAN LINEAR"
        seconds = " ".join(f"{row['cpu all']:7.1f}" for row in (rows[0], twice, four_times))
        lines.append(f"{axis:9s} x 1, 2, 4: {seconds} s of the processor, power {power:.2f}: {verdict}")
    return lines


def violations(rows: list[dict], baseline: list[dict]) -> list[str]:
    """What `--gate` refuses: what grows more from the first case to another than it does in the baseline.

    Raises:
        SystemExit: the baseline is of other cases, another recipe or another number of steps.
    """
    given = ("name", "frames", "width", "height", "variants", "episodes", "recipe", "steps")
    if [[row[key] for key in given] for row in rows] != [[row[key] for key in given] for row in baseline]:
        sys.exit(f"{BASELINE.name} is of other cases than these; expected --small --steps {baseline[0]['steps']}")
    judged = [f"cpu {name}" for name in (*STAGES, "all") if baseline[0][f"cpu {name}"] >= LEAST_S] + ["peak MB"]
    wrong = []
    for row, past in zip(rows[1:], baseline[1:], strict=True):
        for name in judged:
            now, before = row[name] / rows[0][name], past[name] / baseline[0][name]
            if now > SLACK * before:
                wrong.append(f"{row['name']}: {name} is {now:.2f} times the base case's; the baseline has {before:.2f}")
    return wrong


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipe", default="quick")
    parser.add_argument("--steps", type=int, help="of the fit; default: the recipe's")
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--small", action="store_true", help="half the size, half the frames")
    size.add_argument("--growth", action="store_true", help="each of frames, pixels, variants, episodes 2 and 4 times")
    size.add_argument("--so101", type=int, metavar="N", help="N episodes as an SO-101's users have them, and seams")
    size.add_argument("--long", action="store_true", help="300 and 3,000 frames instead")
    parser.add_argument("--gate", action="store_true", help=f"fail where something grows more than in {BASELINE.name}")
    parser.add_argument("--data", type=Path, help="of --so101: keep the dataset here, or use the one that is here")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if options.data is not None and not options.so101:
        parser.error("--data is for --so101 N, whose one dataset it holds")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # of the processes that are started; as the command does
    rows: list[dict] = []
    cases = LONG if options.long else SMALL if options.small else GROWTH if options.growth else CASES
    if options.so101:
        cases = (Case("SO-101", 441, 640, 480, episodes=options.so101, whole=True),)
    columns = (*cases[0].stages, "all", "peak MB")
    sys.stdout.write(f"{'seconds':14s}" + "".join(f"{name:>{max(9, len(name) + 2)}s}" for name in columns) + "\n")
    for case in cases:
        row, seams = run(case, options.recipe, options.steps, options.data)
        rows.append(asdict(case) | {"recipe": options.recipe, "steps": options.steps} | row)
        line = "".join(f"{row[name]:{max(9, len(name) + 2)}.1f}" for name in columns)
        sys.stdout.write(f"{case.name:14s}{line}\n")
        line = "".join(f"{row.get(f'cpu {name}', 0.0):{max(9, len(name) + 2)}.1f}" for name in columns[:-1])
        sys.stdout.write(f"{'  processor':14s}{line}\n" + "".join(f"{seam}\n" for seam in seams))
        if len(rows) > 1:
            sys.stdout.write(f"{'  times base':14s}{growth(row, rows[0], columns)}\n")
        sys.stdout.flush()
    sys.stdout.write("".join(f"{line}\n" for line in powers(rows)) if options.growth else "")
    wrong = violations(rows, json.loads(BASELINE.read_text())) if options.gate else []
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")
    sys.stdout.write("".join(f"{line}\n" for line in wrong))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
