"""Writes a synthetic dataset, or one scene with its true held-out views, to a new folder."""

import argparse
import logging
from pathlib import Path

from lerobot_msdyn.core.cli import EXIT_OK, run_command
from lerobot_msdyn.synthetic.choreography import KINDS

logger = logging.getLogger("lerobot_msdyn.synthetic")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m lerobot_msdyn.synthetic",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to create")
    parser.add_argument(
        "--layout",
        choices=("dataset", "nvs", "iphone"),
        default="dataset",
        help="dataset: LeRobot v3.0; nvs: one episode with held-out views and all ground truth; "
        "iphone: one episode in the layout of DyCheck's sequences, with Shape of Motion's package",
    )
    parser.add_argument("--kind", choices=KINDS, default="push", help="what moves")
    parser.add_argument("--episodes", type=int, default=2, help="episodes at the same desk (layout dataset)")
    parser.add_argument("--cameras", nargs="+", default=["front"], help="front, side, wrist (layout dataset)")
    parser.add_argument("--depth", action="store_true", help="record depth as well (layout dataset)")
    parser.add_argument("--frames", type=int, default=60, help="frames per episode")
    parser.add_argument("--width", type=int, default=160, help="px")
    parser.add_argument("--height", type=int, default=120, help="px")
    parser.add_argument("--fps", type=int, default=30)
    parser.add_argument("--sway_deg", type=float, default=4.0, help="of the camera, to either side (layout iphone)")
    parser.add_argument(
        "--network_depth", action="store_true", help="depth as a monocular network would give it (layout iphone)"
    )
    parser.add_argument("--seed", type=int, default=0, help="decides the desk's textures and clutter")
    return parser


def run(arguments: list[str]) -> int:
    """Make and write; returns the exit code."""
    a = _parser().parse_args(arguments)
    # seconds to import, and --help needs none of it
    from lerobot_msdyn.dataset.video import quiet_encoders
    from lerobot_msdyn.synthetic import make_scene, write_dataset, write_iphone_folder, write_nvs_folder

    quiet_encoders()
    count = a.episodes if a.layout == "dataset" else 1
    scenes = [make_scene(a.kind, a.seed, a.frames, a.width, a.height, a.fps, episode=e) for e in range(count)]
    if a.layout == "dataset":
        write_dataset(scenes, f"synthetic/{a.out.name}", a.out, cameras=a.cameras, depth=a.depth)
    elif a.layout == "nvs":
        write_nvs_folder(scenes[0], a.out)
    else:
        write_iphone_folder(scenes[0], a.out, sway_deg=a.sway_deg, network_depth=a.network_depth)
    logger.info("wrote %d episode(s) of %d frames to %s", count, a.frames, a.out)
    return EXIT_OK


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
