"""A loss term of your own: moving Gaussians that are much longer than wide are made rounder.

python examples/10_own_loss.py [--frames 60] [--steps 500]

It runs `python -m lerobot_msdyn.augment ... --plugins examples/10_own_loss.py --fit.weights.slender 0.01`. In a package
of yours an entry point takes the place of `--plugins`:

[project.entry-points."lerobot_msdyn.reconstruction.losses"]
slender = "my_package.losses:slender"
"""

import argparse
import math
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.registries import LOSSES
from lerobot_msdyn.reconstruction.loss_terms import FitStep

CAMERA = "observation.images.front"
LONGEST = 3.0  # times the second longest axis, beyond which a Gaussian is slender


@LOSSES.register("slender")
def slender(step: FitStep) -> Float[Tensor, ""]:
    """How far the longest axis exceeds `LONGEST` times the next: mean of the logarithm over the moving set."""
    longest, second, _ = step.scene.moving.scales.log().sort(dim=-1, descending=True).values.unbind(-1)
    return (longest - second - math.log(LONGEST)).clamp(min=0).sum() / max(len(longest), 1)


def main() -> None:
    """Run the example with and without the term."""
    from lerobot_msdyn.augment import __main__ as augment
    from lerobot_msdyn.scene import store
    from lerobot_msdyn.synthetic import make_scene
    from lerobot_msdyn.synthetic.dataset import write_dataset

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("example_out/own_loss"))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--steps", type=int, default=500, help="of the fit")
    arguments = parser.parse_args()

    root = arguments.out / "desk"
    write_dataset([make_scene("push", 0, arguments.frames, 160, 120)], "local/desk", root, depth=True)
    for weight in (0.0, 0.01):
        out = arguments.out / f"weight_{weight:g}"
        flags = {"repo": "local/desk", "root": root, "new_root": out, "plugins": __file__, "variants": 1}
        flags |= {"save_scenes": "true", "fit.steps": arguments.steps, "fit.weights.slender": weight}
        augment.run([f"--{name}={value}" for name, value in flags.items()])
        moving = store.load(store.list_scenes(out)[0][CAMERA]).windows[0].moving
        longest, second, _ = moving.scales.sort(dim=-1, descending=True).values.unbind(-1)
        print(f"weight {weight:g}: longest axis {float((longest / second).mean()):.4f} times the second")


if __name__ == "__main__":
    main()
