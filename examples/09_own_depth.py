"""Depth of your own: a provider that registers itself, in a file that a command line names as a plugin.

python examples/09_own_depth.py [--frames 60] [--steps 500]

It runs `python -m lerobot_msdyn.augment ... --plugins examples/09_own_depth.py --priors.depth two_walls`. In a package
of yours an entry point takes the place of `--plugins` (masks, tracks and cameras have groups of their own):

[project.entry-points."lerobot_msdyn.priors.depth.providers"]
two_walls = "my_package.two_walls:TwoWalls"
"""

import argparse
import json
from pathlib import Path

import torch

from lerobot_msdyn.core.observations import DepthTraits, Model
from lerobot_msdyn.priors.registry import DEPTH, Depth, DepthProvider, Estimate, Masks, Unusable
from lerobot_msdyn.priors.request import Request

CAMERA = "observation.images.front"
FAR_M = 1.2


@DEPTH.register("two_walls")
class TwoWalls(DepthProvider):
    """The background is one wall, and what moves another, in front of it: stands for your network."""

    rank = 45  # priors.depth auto: after recorded depth (50), before Depth Anything (40, 30), stereo (20), plane (10)
    reads_recorded_depth = False  # nothing is decoded for it

    def usable(self, request: Request) -> str:
        """Why it can be used, for the log; raises where it cannot."""
        if len(request.view) < 2:
            raise Unusable("one frame shows no motion", "use --priors.depth plane")
        return "two walls are always at hand"

    def estimate(self, request: Request, instances: Masks) -> Estimate[Depth]:
        """z-depth in metres [t,h,w], what it is worth, and the model and licence that the output names."""
        near_m = 0.8 * FAR_M
        z = torch.where(instances > 0, near_m, FAR_M)
        traits = DepthTraits(metric=False, sharp=True, relative_error=0.2)
        return Estimate(Depth(z, traits), f"walls at {near_m:g} and {FAR_M:g} m", Model("me/two-walls", "1", "MIT"))


def main() -> None:
    """Run the example."""
    from lerobot_msdyn.augment import __main__ as augment
    from lerobot_msdyn.dataset.provenance import read_provenance
    from lerobot_msdyn.synthetic import make_scene
    from lerobot_msdyn.synthetic.dataset import write_dataset

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("example_out/own_depth"))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--steps", type=int, default=500, help="of the fit")
    arguments = parser.parse_args()

    root = arguments.out / "desk"
    write_dataset([make_scene("push", 0, arguments.frames, 160, 120)], "local/desk", root)
    flags = {"repo": "local/desk", "root": root, "plugins": __file__, "priors.depth": "two_walls", "variants": 1}
    augment.run([f"--{name}={value}" for name, value in (flags | {"fit.steps": arguments.steps}).items()])
    episodes = read_provenance(arguments.out / "desk_msdyn")
    assert episodes is not None
    print(json.loads(episodes[-1]["priors"])[CAMERA]["depth"])


if __name__ == "__main__":
    main()
