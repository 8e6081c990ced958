"""A motion level of your own: bases in the cells of a grid, a file that a command line names as a plugin.

python examples/08_own_motion_level.py [--frames 60] [--steps 500]

It runs `python -m lerobot_msdyn.augment ... --plugins examples/08_own_motion_level.py --motion.levels '[object,cell]'`.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.registries import MOTION_LEVELS
from lerobot_msdyn.motion.finer.residual import ResidualTracks
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.model.binding import nearest_bases
from lerobot_msdyn.motion.spec import Binding, FinerLevel
from lerobot_msdyn.scene import store
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset

CAMERA = "observation.images.front"


@dataclass
class CellSettings:
    """What `motion.settings.cell` may hold."""

    # Side of a cell, in m.
    side_m: float = between(0.05, 0.001, 10)


@MOTION_LEVELS.register("cell")
class Cells(FinerLevel):
    """One basis per cell of a grid over each rigid part."""

    after = ("object",)
    frames_per_knot = 2
    settings = CellSettings

    def cluster(self, tracks: ResidualTracks, config: MotionConfig, noise: float) -> Int[Tensor, " n"]:
        """The tracks of a part, by the cell that they are in."""
        side = config.settings_of("cell", CellSettings).side_m
        return (tracks.points / side).floor().unique(dim=0, return_inverse=True)[1]

    def bind(
        self, level: MotionLevel, points: Float[Tensor, "n 3"], part: Int[Tensor, " n"], coarser: Binding | None
    ) -> Binding:
        """The nearest cells of its part."""
        return nearest_bases(level, points, part[:, None], 4)


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("example_out/own_motion_level"))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--steps", type=int, default=500, help="of the fit")
    arguments = parser.parse_args()

    root = arguments.out / "desk"
    write_dataset([make_scene("sheet", 0, arguments.frames, 160, 120)], "local/desk", root, depth=True)
    flags = {"repo": "local/desk", "root": root, "variants": 1, "save_scenes": "true", "fit.steps": arguments.steps}
    flags |= {"motion.levels": "[object,cell]", "motion.settings.cell.side_m": 0.04, "motion.gate": "false"}
    augment.run([f"--{name}={value}" for name, value in flags.items()])
    window = store.load(store.list_scenes(arguments.out / "desk_msdyn")[0][CAMERA]).windows[0]
    parts, cells = (level for level in window.levels if isinstance(level, MotionLevel))
    print(f"{len(parts)} parts, {len(cells)} cells, {len(window.moving)} moving Gaussians")


if __name__ == "__main__":
    main()
