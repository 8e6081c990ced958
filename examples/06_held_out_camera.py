"""How good are the new views? Fit an episode, render cameras that were not used, compare with what they saw.

python examples/06_held_out_camera.py [--frames 60] [--steps 500]
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from lerobot_msdyn.core.cli import parse_config
from lerobot_msdyn.evaluate.config import EvaluateConfig
from lerobot_msdyn.evaluate.nvs import evaluate_nvs
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.nvs import write_nvs_folder


def psnr_db(folder: Path, truth: Path) -> float:
    """Mean over the pictures of a folder."""
    values = []
    for path in sorted(folder.glob("*.png")):
        rendered, true = cv2.imread(str(path)), cv2.imread(str(truth / path.name))
        assert rendered is not None
        assert true is not None
        difference = rendered.astype(float) - true
        values.append(10 * np.log10(255**2 / (difference**2).mean()))
    return float(np.mean(values))


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("example_out/held_out"))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--steps", type=int, default=500, help="of the fit")
    arguments = parser.parse_args()

    scene, views = arguments.out / "scene", arguments.out / "views"
    write_nvs_folder(make_scene("push", 0, arguments.frames, 160, 120), scene)
    flags = ["--scene", str(scene), "--out", str(views), "--fit.steps", str(arguments.steps)]
    evaluate_nvs(parse_config(EvaluateConfig, flags, {"scene": "scene_folder"}, command="example"))
    for folder in sorted(views.iterdir()):
        print(f"{folder.name:16s}{psnr_db(folder, scene / 'gt' / 'heldout' / folder.name):6.1f} dB")


if __name__ == "__main__":
    main()
