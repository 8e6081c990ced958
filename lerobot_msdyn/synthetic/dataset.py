"""Synthetic scenes as a LeRobot v3.0 dataset, written through LeRobot's own recording API."""

import contextlib
import logging
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_msdyn.core.errors import ConfigError, OutputError
from lerobot_msdyn.synthetic.choreography import STATE_NAMES
from lerobot_msdyn.synthetic.scene import SyntheticScene, SyntheticView

logger = logging.getLogger(__name__)

IMAGE_DTYPES = ("video", "image")


def write_dataset(
    scenes: Sequence[SyntheticScene],
    repo_id: str,
    root: Path,
    *,
    cameras: Sequence[str] = ("front",),
    depth: bool = False,
    image_dtype: str = "video",
    rgb_encoder: Any = None,
) -> None:
    """Records one episode per scene from the named cameras ("front", "side", "wrist").

    With `depth`, every camera gets a sibling `observation.images.<camera>_depth` (uint16 millimetres, as depth
    cameras deliver it). `rgb_encoder` is a `lerobot.configs.RGBEncoderConfig`, by default LeRobot's own choice.

    Raises:
        ConfigError: no scene, scenes of unequal size or rate, an unknown camera or image dtype.
        OutputError: `root` exists.
    """
    if not scenes or not cameras:
        raise ConfigError(f"a dataset needs at least one scene and camera; got {len(scenes)} and {len(cameras)}")
    unknown = sorted(set(cameras) - set(scenes[0].cameras))
    if unknown:
        raise ConfigError(f"synthetic scenes have no camera {unknown}; expected some of {sorted(scenes[0].cameras)}")
    shapes = {(s.fps, s.camera.width, s.camera.height) for s in scenes}
    if len(shapes) > 1:
        raise ConfigError(f"all scenes of a dataset need one (fps, width, height); got {sorted(shapes)}")
    episodes = ((scene, {name: scene.render(scene.cameras[name]) for name in cameras}) for scene in scenes)
    features = features_of(scenes[0], cameras, depth=depth, image_dtype=image_dtype)
    record(episodes, features, repo_id, root, fps=scenes[0].fps, rgb_encoder=rgb_encoder)


def features_of(scene: SyntheticScene, cameras: Sequence[str], *, depth: bool, image_dtype: str) -> dict[str, dict]:
    """The features of LeRobot's `meta/info.json`."""
    if image_dtype not in IMAGE_DTYPES:
        raise ConfigError(f"image_dtype {image_dtype!r} is unknown; expected one of {IMAGE_DTYPES}")
    axes = ["height", "width", "channels"]
    size = (scene.camera.height, scene.camera.width)
    vector = {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": list(STATE_NAMES)}
    features: dict[str, dict] = {"observation.state": vector, "action": dict(vector)}
    for name in cameras:
        features[f"observation.images.{name}"] = {"dtype": image_dtype, "shape": (*size, 3), "names": axes}
        if depth:
            features[f"observation.images.{name}_depth"] = {
                "dtype": image_dtype,
                "shape": (*size, 1),
                "names": axes,
                "info": {"is_depth_map": True},
            }
    return features


def record(
    episodes: Iterable[tuple[SyntheticScene, Mapping[str, SyntheticView]]],
    features: dict[str, dict],
    repo_id: str,
    root: Path,
    *,
    fps: int,
    rgb_encoder: Any = None,
) -> None:
    """Records rendered scenes with exactly the given features.

    Raises:
        OutputError: `root` exists.
    """
    # importing LeRobot's datasets takes seconds, and a scene alone needs none of it
    from lerobot.configs import DepthEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_msdyn.dataset.video import tamed_av1

    if root.exists():
        raise OutputError(f"{root} exists already; remove it or choose another folder for the synthetic dataset")
    dataset = LeRobotDataset.create(
        repo_id,
        fps,
        features,
        root=root,
        robot_type="synthetic_arm",
        use_videos=any(feature["dtype"] == "video" for feature in features.values()),
        video_backend="pyav",
        rgb_encoder=rgb_encoder,
        depth_encoder=DepthEncoderConfig(extra_options={"x265-params": "lossless=1:log-level=error"}),
    )
    for index, (scene, views) in enumerate(episodes):
        for t in range(len(scene)):
            dataset.add_frame(_frame(scene, views, features, t))
        with tamed_av1(), _without_bars():
            # one process: forking beside the ray-caster's threads can hang
            dataset.save_episode(parallel_encoding=False)
        logger.info("episode %d: %d frames recorded", index, len(scene))
    dataset.finalize()
    _remove_empty(root / "images")  # where LeRobot has kept frames until their videos were encoded


@contextlib.contextmanager
def _without_bars() -> Iterator[None]:
    """LeRobot's own progress bars, of a tenth of a second each, are not shown."""
    from datasets import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars

    shown = not are_progress_bars_disabled()
    disable_progress_bars()
    try:
        yield
    finally:
        if shown:
            enable_progress_bars()


def _remove_empty(folder: Path) -> None:
    """Remove a folder if no file lies in it, at any depth."""
    if folder.is_dir() and not any(path.is_file() for path in folder.rglob("*")):
        shutil.rmtree(folder)


def _frame(
    scene: SyntheticScene, views: Mapping[str, SyntheticView], features: Mapping[str, dict], t: int
) -> dict[str, Any]:
    """What LeRobot's `add_frame` takes for one time."""
    frame: dict[str, Any] = {
        "observation.state": scene.state[t].numpy(),
        "action": scene.action[t].numpy(),
        "task": scene.task,
    }
    for name, view in views.items():
        frame[f"observation.images.{name}"] = view.rgb[t].numpy()
        if f"observation.images.{name}_depth" in features:
            millimetres = np.rint(1000 * view.depth[t, ..., None].numpy())
            frame[f"observation.images.{name}_depth"] = millimetres.astype(np.uint16)
    return frame
