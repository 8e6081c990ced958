"""Bring masks, depth, tracks or cameras from a model of your own: an exchange file (docs/priors.md).

Where it can run in this environment, a provider needs no files: 09_own_depth.py.

python examples/04_own_prior.py [--frames 60] [--steps 500]
"""

import argparse
from dataclasses import replace
from pathlib import Path

from lerobot_msdyn import load_recipe, open_source, read_episode, reconstruct
from lerobot_msdyn.priors.exchange import Exchange, write_exchange
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset

CAMERA = "observation.images.front"


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("example_out/own_prior"))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--steps", type=int, default=500, help="of the fit")
    arguments = parser.parse_args()

    synthetic = make_scene("push", 0, arguments.frames, 160, 120)
    write_dataset([synthetic], "local/desk", arguments.out / "desk")
    truth = synthetic.render(synthetic.camera)  # stands for what your model predicts
    file = arguments.out / "my_model.npz"
    content = Exchange(arguments.frames, 120, 160, episode=0, camera=CAMERA, depth=truth.depth.numpy())
    write_exchange(file, content)

    recipe = load_recipe("quick")
    recipe = replace(
        recipe,
        fit=replace(recipe.fit, steps=arguments.steps),
        priors=replace(recipe.priors, depth=str(file)),
    )
    source = open_source("local/desk", arguments.out / "desk")
    view = read_episode(source, 0, [CAMERA], recipe.camera).views[CAMERA]
    scene = reconstruct(view, recipe, episode=0, key=CAMERA)
    print({name: origin["provider"] for name, origin in scene.provenance.items()})
    print(f"{scene.windows[0].train_psnr_db:.1f} dB on the recorded camera")


if __name__ == "__main__":
    main()
