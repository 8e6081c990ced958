"""Command line: frames of a kept scene as .ply files, in the layout of 3D Gaussian Splatting.

python -m lerobot_msdyn.export_ply --scenes local/ds_msdyn --episode 0 --frames 0-9 --out ply
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_msdyn.core.cli import EXIT_OK, parse_config, run_command
from lerobot_msdyn.core.errors import ConfigError, OutputError
from lerobot_msdyn.core.fields import MAX_INDEX, between
from lerobot_msdyn.dataset.named import output_folder
from lerobot_msdyn.scene.folders import list_scenes

COMMAND = "python -m lerobot_msdyn.export_ply"


@dataclass
class ExportPlyConfig:
    """`python -m lerobot_msdyn.export_ply`: frames of a kept scene as .ply files."""

    # Output of `augment --save_scenes true`, a folder or a name.
    scenes: Path | None = None
    # The source episode.
    episode: int = between(0, 0, MAX_INDEX)
    # The camera, by feature key or its last part; default: the first that has a scene.
    camera: str = ""
    # The frames, e.g. 0, 0,3 or 0-9.
    frames: list[int] = field(default_factory=lambda: [0])
    # Where the files go: OUT/frame_000000.ply.
    out: Path = Path("ply")


def run(arguments: list[str]) -> int:
    """Write the files and name them; returns the exit code."""
    config = parse_config(ExportPlyConfig, arguments, {}, command=COMMAND)
    if config.scenes is None:
        raise ConfigError(f"which scenes? {COMMAND} --scenes FOLDER [--episode 0] [--frames 0-9] (see --help)")
    scenes = list_scenes(output_folder(config.scenes))
    if config.episode not in scenes:
        there = ", ".join(map(str, scenes))
        raise ConfigError(f"{config.scenes}: no scene of episode {config.episode}; there are those of {there}")
    cameras = scenes[config.episode]
    names = [key for key in cameras if config.camera in ("", key, key.rsplit(".", 1)[-1])]
    if not names:
        raise ConfigError(f"{config.scenes}: no scene of camera {config.camera!r}; there are {', '.join(cameras)}")
    from lerobot_msdyn.scene.ply import export_frames  # torch takes long: only now
    from lerobot_msdyn.scene.store import load

    scene = load(cameras[names[0]])
    beyond = [frame for frame in config.frames if not 0 <= frame < len(scene)]
    if beyond:
        raise ConfigError(f"frames: no frame {beyond[0]}; episode {config.episode} has 0 to {len(scene) - 1}")
    try:
        paths = export_frames(scene, config.frames, config.out)
    except OSError as error:
        raise OutputError(f"{config.out} cannot be written ({error}); choose another folder by --out") from error
    sys.stdout.write("".join(f"{path}\n" for path in paths))
    return EXIT_OK


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
