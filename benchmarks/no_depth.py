"""The picture of docs/images/no_depth.jpg: a recorded frame without depth, and the same from cameras that were turned.

python benchmarks/no_depth.py --out /tmp/no_depth       writes /tmp/no_depth/no_depth.jpg
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.core.perturbation import AMOUNTS, Perturbation, Viewpoint

CAMERA = "observation.images.front"
TURNS_DEG = (-4.0, -12.0)  # one new episode each
SHARE = 0.55  # of the episode: the frame that is shown
WIDTH, HEIGHT, GAP = 400, 300, 6  # px


@Perturbation.register_subclass("turns")
@dataclass
class Turns(Perturbation):
    """Turn the camera about what it looks at, each new episode by a given angle."""

    moves_rig: ClassVar[bool] = True
    allows_per_frame: ClassVar[bool] = False

    def amounts(self, shares: np.ndarray, view: Viewpoint, variant: int) -> np.ndarray:
        """The angle of this new episode, and nothing else."""
        return np.array([[TURNS_DEG[variant] if name == "azimuth_deg" else 0.0 for name in AMOUNTS]], np.float32)


def main() -> None:
    """Record an episode, render it anew, and put the pictures side by side."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder to create")
    parser.add_argument("--frames", type=int, default=60, help="of the episode")
    parser.add_argument("--steps", type=int, default=500, help="of the fit")
    arguments = parser.parse_args()
    # seconds to import, and --help needs none of it
    from lerobot.datasets import LeRobotDataset

    from lerobot_msdyn.synthetic import make_scene, write_dataset

    root, new_root = arguments.out / "desk", arguments.out / "desk_msdyn"
    write_dataset([make_scene("push", 0, arguments.frames, 640, 480)], "local/desk", root)
    flags: dict[str, object] = {"repo": "local/desk", "root": root, "recipe": "so101_front"}
    flags |= {"fit.steps": arguments.steps, "perturbation.type": "turns", "variants": len(TURNS_DEG)}
    # shown as it is: neither shrunk nor dropped
    flags |= {"gate.enabled": "false", "max_unseen": 1, "priors.depth": "plane"}
    augment.run([f"--{name}={value}" for name, value in flags.items()])

    dataset = LeRobotDataset("local/desk_msdyn", root=new_root, video_backend="pyav")
    frame = round(SHARE * (arguments.frames - 1))
    pictures = []
    for episode in range(1 + len(TURNS_DEG)):
        image = dataset[episode * arguments.frames + frame][CAMERA]
        picture = (255 * image.permute(1, 2, 0)).round().byte().numpy()[..., ::-1]
        pictures += [cv2.resize(picture, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)]
        pictures += [np.full((HEIGHT, GAP, 3), 255, np.uint8)]
    cv2.imwrite(str(arguments.out / "no_depth.jpg"), np.concatenate(pictures[:-1], axis=1))


if __name__ == "__main__":
    main()
