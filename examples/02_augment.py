"""Augment a dataset from Python: the same as `python -m lerobot_msdyn.augment`, one step at a time.

python examples/02_augment.py [--frames 60] [--steps 500]
"""

import argparse
from dataclasses import replace
from pathlib import Path

from lerobot.datasets import LeRobotDataset

from lerobot_msdyn import OutputDataset, augment_episode, load_recipe, open_source
from lerobot_msdyn.dataset.select import select_cameras
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("example_out/augment"))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--steps", type=int, default=500, help="of the fit")
    arguments = parser.parse_args()

    write_dataset([make_scene("push", 0, arguments.frames, 160, 120)], "local/desk", arguments.out / "desk", depth=True)
    source = open_source("local/desk", arguments.out / "desk")
    recipe = load_recipe("quick")
    recipe = replace(recipe, variants=1, fit=replace(recipe.fit, steps=arguments.steps))
    with OutputDataset(source, "local/desk_msdyn", arguments.out / "desk_msdyn") as output:
        new = augment_episode(source, 0, select_cameras(source, None), recipe, output)
        output.finish(new, "")
    dataset = LeRobotDataset("local/desk_msdyn", root=arguments.out / "desk_msdyn", video_backend="pyav")
    print(f"{dataset.num_episodes} episodes: the recorded one, and one seen from elsewhere")
    print(f"perturbation: {new[1].provenance.perturbation}")


if __name__ == "__main__":
    main()
