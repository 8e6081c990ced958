"""A camera change of your own: it swings around the scene over the episode, looking at it all the time.

python examples/03_own_perturbation.py [--frames 60] [--steps 500]

This file is also a plugin, for datasets of your own:

python -m lerobot_msdyn.augment --repo local/ds --plugins examples/03_own_perturbation.py --perturbation.type swing
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.perturbation import Perturbation, Viewpoint

CAMERA = "observation.images.front"


@Perturbation.register_subclass("swing")
@dataclass
class Swing(Perturbation):
    """Swing the camera to one side of the scene and to the other."""

    moves_rig: ClassVar[bool] = True  # calibrated cameras move as one body

    # Largest turn to either side, in degrees.
    azimuth_deg: float = between(15.0, 0, 90)

    def bounds(self, view: Viewpoint) -> dict[str, int | float]:
        """The largest amounts by name: lerobot_msdyn.core.perturbation.AMOUNTS has all of them."""
        return {"azimuth_deg": self.azimuth_deg}

    def shares(self, uniform: np.ndarray, phases: np.ndarray, frames: int) -> np.ndarray:
        """Shares of the bounds, -1..1, one row per frame: one swing, which begins anywhere."""
        if self.per_frame:
            return super().shares(uniform, phases, frames)
        time = np.linspace(0, 1, frames, dtype=np.float32)[:, None]
        return np.sin(2 * np.pi * (time + phases))


def main() -> None:
    """Run the example."""
    import cv2
    from lerobot.datasets import LeRobotDataset

    from lerobot_msdyn.augment import __main__ as augment
    from lerobot_msdyn.synthetic import make_scene
    from lerobot_msdyn.synthetic.dataset import write_dataset

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("example_out/own_perturbation"))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--steps", type=int, default=500, help="of the fit")
    arguments = parser.parse_args()

    root, new_root = arguments.out / "desk", arguments.out / "desk_msdyn"
    write_dataset([make_scene("push", 0, arguments.frames, 160, 120)], "local/desk", root, depth=True)
    flags = {"repo": "local/desk", "root": root, "recipe": "quick", "fit.steps": arguments.steps, "variants": 1}
    flags |= {"include_source": "false", "perturbation.type": "swing", "perturbation.azimuth_deg": 12}
    augment.run([f"--{name}={value}" for name, value in flags.items()])

    dataset = LeRobotDataset("local/desk_msdyn", root=new_root, video_backend="pyav")
    chosen = np.linspace(0, len(dataset) - 1, 4).round().astype(int)
    pictures = [(255 * dataset[i][CAMERA].permute(1, 2, 0)).round().byte().numpy() for i in chosen.tolist()]
    path = arguments.out / "swing.png"
    cv2.imwrite(str(path), np.concatenate(pictures, axis=1)[..., ::-1])
    print(f"four of {len(dataset)} frames of the swing: {path}")


if __name__ == "__main__":
    main()
