"""Decides which samples are seen from elsewhere, and draws them: a function of (seed, epoch, index) alone."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from lerobot.configs import DepthEncoderConfig
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import OtherCameraConfig, PerturbationConfig
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.fields import problems
from lerobot_msdyn.dataset.read import MILLIMETRES, depth_key_of
from lerobot_msdyn.scene.store import SavedScene
from lerobot_msdyn.training.config import MixedViewsConfig
from lerobot_msdyn.training.live import LiveScene
from lerobot_msdyn.training.matching import recipe_of, scenes_of
from lerobot_msdyn.training.scene_cache import SceneCache, Scenes
from lerobot_msdyn.views.coverage import HOLE_ALPHA
from lerobot_msdyn.views.perturbation import Viewpoint, amounts_of, draw, moved

FACTORS = (1.0, 0.5, 0.25)  # of a change that was drawn, until little enough of the picture is empty


class ViewMixer:
    """New views of a dataset's samples."""

    def __init__(
        self,
        meta: LeRobotDatasetMetadata,
        episodes: list[int] | None,
        deltas: dict[str, list[int]],
        scenes: str | os.PathLike[str] | Scenes,
        probability: float,
        perturbation: PerturbationConfig | None,
        seed: int,
        memory_mb: float,
    ) -> None:
        """See `MixedViews`; `deltas` are the observation windows of the cameras, in frames.

        Raises:
            ConfigError: a value is out of range.
            MsdynError: there are no scenes, or they are of other videos.
        """
        found = problems(MixedViewsConfig(probability=probability, seed=seed, memory_mb=memory_mb))
        if found:
            raise ConfigError("; ".join(found))
        if isinstance(scenes, str | os.PathLike):
            scenes = Path(scenes)
        self.probability, self.seed, self.deltas = probability, seed, deltas
        recipe = recipe_of(scenes)
        self.perturbation = recipe.perturbation if perturbation is None else perturbation
        self.max_empty = recipe.max_unseen
        if isinstance(self.perturbation, OtherCameraConfig):
            raise ConfigError(
                "perturbation is 'other_camera', whose pose is not kept with the scenes; choose another kind"
            )
        self.cache = SceneCache(scenes_of(meta, episodes, scenes), memory_mb)
        self.depth_keys = {camera: depth_key_of(meta, camera) for camera in meta.camera_keys}
        self._lengths = [int(length) for length in meta.episodes["length"]]
        self._epoch = torch.zeros(1, dtype=torch.long).share_memory_()  # one number for all workers, whenever started

    @property
    def epoch(self) -> int:
        """Which epoch it is: every one sees other views."""
        return int(self._epoch[0])

    def set_epoch(self, epoch: int) -> None:
        """Tell this process and all its workers which epoch it is."""
        self._epoch[0] = epoch

    def replaced(self, episode: int, index: int) -> list[str]:
        """The cameras of a sample that are to be drawn in this epoch; none, if it stays as recorded."""
        if np.random.default_rng([self.seed, self.epoch, index]).random() >= self.probability:
            return []
        return sorted(self.cache.scenes.get(episode, ()))

    def draw(self, episode: int, position: int, index: int, cameras: list[str]) -> dict[str, np.ndarray]:
        """The windows of some cameras and of their depth (if recorded), by feature; each through one new pose.

        A pose from which more than `max_empty` of a picture shows nothing is brought half as far, and again.
        Colours are uint8 [t,3,h,w], depth float32 [t,h,w] in m.

        Args:
            episode: of the dataset.
            position: frame in the episode.
            index: in the whole dataset.
            cameras: from `replaced`.
        """
        live = {camera: self.cache.get(episode, camera) for camera in cameras}
        for factor in FACTORS:
            seen_from = new_cameras(
                self.perturbation,
                {camera: one.scene for camera, one in live.items()},
                self.seed,
                index,
                self.epoch,
                position,
                factor,
            )
            pictures: dict[str, np.ndarray] = {}
            emptiest = 0.0
            for camera in cameras:
                found, empty = self._windows(live[camera], seen_from[camera], camera, position, episode)
                pictures |= found
                emptiest = max(emptiest, empty)
            if emptiest <= self.max_empty:
                break
        return pictures

    def _windows(
        self, live: LiveScene, seen_from: CameraTrack, camera: str, position: int, episode: int
    ) -> tuple[dict[str, np.ndarray], float]:
        """The windows of one camera and of its depth, and the largest share of a picture in which nothing is."""
        depth_key = self.depth_keys[camera]
        colour = [position + delta for delta in self.deltas.get(camera, [0])]
        depth = [] if depth_key is None else [position + delta for delta in self.deltas.get(depth_key, [0])]
        within = np.clip(colour + depth, 0, self._lengths[episode] - 1)
        wanted, places = np.unique(within, return_inverse=True)
        frames = torch.from_numpy(wanted)
        drawn = live.draw(seen_from.select(frames), frames)
        pictures = {camera: drawn.rgb[places[: len(colour)]]}
        if depth_key is not None:
            pictures[depth_key] = drawn.depth[places[len(colour) :]]
        return pictures, float((drawn.alpha < HOLE_ALPHA).mean((1, 2)).max())


def new_cameras(
    config: PerturbationConfig,
    scenes: Mapping[str, SavedScene],
    seed: int,
    index: int,
    epoch: int,
    position: int,
    factor: float = 1.0,
) -> dict[str, CameraTrack]:
    """One draw for all cameras of a sample, for all frames of the episode.

    The epochs of a sample are stratified as the variants of an episode are. Changes that differ from frame to frame
    are taken as they are at the sample's own: a window has one pose. `factor` is the share of the change that is made.
    """
    views = {key: Viewpoint(scene.camera, scene.distance, scene.metric) for key, scene in scenes.items()}
    if not views:
        return {}
    frames = min(len(scene) for scene in scenes.values())
    share = draw(config, seed, index, epoch, frames)
    share = share[position : position + 1] if len(share) > 1 else share
    amounts = {key: factor * amounts_of(config, share, view, epoch) for key, view in views.items()}
    return moved(config, views, amounts)


def colour_sample(rgb: UInt8[np.ndarray, "t 3 h w"], dtype: torch.dtype, *, windowed: bool) -> Tensor:
    """Colours as a dataset returns them: uint8, or floats 0..1; [c,h,w], or [t,c,h,w] for a window."""
    images = torch.from_numpy(rgb)
    images = images if dtype == torch.uint8 else images.to(dtype) / 255
    return images if windowed else images[0]


def depth_sample(
    depth_m: Float32[np.ndarray, "t h w"], meta: LeRobotDatasetMetadata, key: str, unit: str, *, windowed: bool
) -> Tensor:
    """Depth as a dataset returns it, in mm or m; [1,h,w], or [t,1,h,w] for a window."""
    depth = torch.from_numpy(depth_m)[:, None]
    if key in meta.video_keys:  # which cannot say less than that, nor more
        encoder = DepthEncoderConfig.from_video_info(meta.features[key].get("info") or {})
        depth = depth.clamp(encoder.depth_min, encoder.depth_max)
    depth = depth if unit == "m" else depth * MILLIMETRES
    return depth if windowed else depth[0]
