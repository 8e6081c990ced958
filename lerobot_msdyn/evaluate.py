"""Command line: measure a reconstruction on views that it has not seen.

    python -m lerobot_msdyn.evaluate nvs --scene FOLDER --out DIR

FOLDER holds `dataset/` (a LeRobot dataset with one episode), `dataset_depth/` (the same with recorded depth),
`gt/train.npz` (K and c2w of the recorded camera) and `gt/heldout/<camera>.npz` (frame, c2w, K); see docs/evaluate.md.
Nothing else of `gt/` is read.
"""

import logging
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from lerobot_msdyn.cli import EXIT_OK, parse_config, run_command
from lerobot_msdyn.config import EvaluateConfig
from lerobot_msdyn.errors import ConfigError, DatasetError

logger = logging.getLogger(__name__)

COMMAND = "python -m lerobot_msdyn.evaluate nvs"
ALIASES = {"scene": "scene_folder"}


def run(arguments: list[str]) -> int:
    """Run an evaluation; returns the exit code."""
    if not arguments or arguments[0] not in ("nvs", "-h", "--help"):
        given = arguments[0] if arguments else "nothing"
        raise ConfigError(f"which evaluation? got {given!r}; expected: {COMMAND} --scene FOLDER --out DIR")
    config = parse_config(EvaluateConfig, arguments[arguments[0] == "nvs" :], ALIASES, command=COMMAND)
    for name, path in (("scene", config.scene_folder), ("out", config.out)):
        if path == Path():
            raise ConfigError(f"--{name} is missing; expected: {COMMAND} --scene FOLDER --out DIR")
    evaluate_nvs(config)
    return EXIT_OK


def evaluate_nvs(config: EvaluateConfig) -> dict[str, float]:
    """Fit the episode, render its held-out cameras to `out`, and return the seconds of each stage."""
    import cv2
    import torch

    from lerobot_msdyn.cameras import CameraTrack
    from lerobot_msdyn.episode import open_source, read_episode, select_cameras
    from lerobot_msdyn.pipeline import reconstruct
    from lerobot_msdyn.views import new_pictures

    seconds: dict[str, float] = {}
    start = time.perf_counter()
    folder = config.scene_folder
    recorded = config.depth == "recorded"
    train = _arrays(folder / "gt" / "train.npz", ("K", "c2w"))
    source = open_source(f"local/{folder.name}", folder / ("dataset_depth" if recorded else "dataset"))
    key = select_cameras(source, config.cameras)[0]
    episode = read_episode(source, 0, [key], config.camera, recorded_depth=recorded)
    view = episode.views[key]
    height, width = view.rgb.shape[1:3]

    def track(intrinsics: Any, poses: Any) -> CameraTrack:
        k = torch.as_tensor(intrinsics).float().expand(len(poses), 3, 3).contiguous()
        return CameraTrack(k, torch.as_tensor(poses).float(), width, height)

    view = replace(view, camera=track(train["K"], train["c2w"]))
    seconds["read"] = time.perf_counter() - start
    config.priors.depth = {"recorded": "recorded", "none": "plane"}.get(config.depth, config.depth)
    start = time.perf_counter()
    scene = reconstruct(view, config)
    seconds["priors and initialisation"] = time.perf_counter() - start - scene.seconds
    seconds["fit"] = scene.seconds
    start = time.perf_counter()
    pictures = 0
    for path in sorted((folder / "gt" / "heldout").glob("*.npz")):
        heldout = _arrays(path, ("frame", "c2w", "K"))
        out = config.out / path.stem
        out.mkdir(parents=True, exist_ok=True)
        frames = torch.as_tensor(heldout["frame"]).long()
        for frame, picture in zip(
            frames.tolist(), new_pictures(scene, track(heldout["K"], heldout["c2w"]), frames), strict=True
        ):
            cv2.imwrite(str(out / f"rgb_{frame:04d}.png"), picture.rgb[..., ::-1])
            pictures += 1
    seconds["render"] = time.perf_counter() - start
    for stage, value in seconds.items():
        sys.stdout.write(f"{stage:28s}{value:8.1f} s\n")
    sys.stdout.write(f"{pictures} pictures written to {config.out}\n")
    return seconds


def _arrays(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    """Some arrays of an npz file; the others are not read."""
    import numpy as np

    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in names}
    except (OSError, ValueError, KeyError) as error:
        raise DatasetError(
            f"{path}: expected an npz file with {', '.join(names)} ({error}); see docs/evaluate.md"
        ) from error


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
