"""Look into a saved scene, and take it elsewhere: .ply files that 3D Gaussian Splatting viewers open.

python examples/07_export_scene.py [--frames 60] [--steps 500]
"""

import argparse
from pathlib import Path

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.scene import store as saved
from lerobot_msdyn.scene.ply import export_frames, load_ply
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset

CAMERA = "observation.images.front"


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("example_out/export"))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--steps", type=int, default=500, help="of the fit")
    arguments = parser.parse_args()

    root = arguments.out / "desk"
    write_dataset([make_scene("push", 0, arguments.frames, 160, 120)], "local/desk", root, depth=True)
    flags = {"repo": "local/desk", "root": root, "variants": 1, "save_scenes": "true", "fit.steps": arguments.steps}
    augment.run([f"--{name}={value}" for name, value in flags.items()])

    scene = saved.load(saved.list_scenes(arguments.out / "desk_msdyn")[0][CAMERA])
    print(f"{scene.source}: {len(scene)} frames, looking at something {scene.distance:.2f} m away")
    for start, window in zip(scene.starts, scene.windows, strict=True):
        bases = [len(indices.unique()) for indices in window.indices]
        print(f"from frame {start}: {len(window.static)} static and {len(window.moving)} moving Gaussians,")
        print(f"bases in use, coarse to fine: {bases}")
    first, *_, last = export_frames(scene, range(len(scene)), arguments.out / "ply")
    print(f"{first} to {last.name}; the first holds {len(load_ply(first))} Gaussians")


if __name__ == "__main__":
    main()
