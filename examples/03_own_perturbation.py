"""Move the camera as no recipe does: half a circle around the scene over the episode, looking at it all the time.

python examples/03_own_perturbation.py [--frames 60] [--steps 500]
"""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from lerobot_msdyn import load_recipe, open_source, read_episode, reconstruct, render_frames
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset
from lerobot_msdyn.views.offsets import orbit_offset

CAMERA = "observation.images.front"


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("example_out/own_perturbation"))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--steps", type=int, default=500, help="of the fit")
    arguments = parser.parse_args()

    write_dataset([make_scene("push", 0, arguments.frames, 160, 120)], "local/desk", arguments.out / "desk", depth=True)
    recipe = load_recipe("quick")
    recipe = replace(recipe, fit=replace(recipe.fit, steps=arguments.steps))
    source = open_source("local/desk", arguments.out / "desk")
    view = read_episode(source, 0, [CAMERA], recipe.camera).views[CAMERA]
    scene = reconstruct(view, recipe)

    azimuths = np.linspace(-15, 15, arguments.frames)
    offsets = torch.stack([orbit_offset(azimuth, 3.0, scene.distance) for azimuth in azimuths])
    moved = replace(scene.camera, world_from_camera=scene.camera.world_from_camera @ offsets)
    drawn = torch.cat([part.rgb for part in render_frames(scene.windows[0].scene, moved)])
    pictures = (255 * drawn.clamp(0, 1)).round().byte().numpy()
    chosen = np.linspace(0, len(pictures) - 1, 4).round().astype(int)
    path = arguments.out / "swing.png"
    cv2.imwrite(str(path), np.concatenate(list(pictures[chosen]), axis=1)[..., ::-1])
    print(f"four of {len(pictures)} frames of the swing: {path}")


if __name__ == "__main__":
    main()
