"""Decides which samples are seen from elsewhere, and renders them: a function of (seed, epoch, index) alone."""

import os
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from lerobot.configs import DepthEncoderConfig
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.fields import problems
from lerobot_msdyn.core.perturbation import Perturbation, check_pose
from lerobot_msdyn.dataset.named import output_folder
from lerobot_msdyn.dataset.read import MILLIMETRES, depth_key_of
from lerobot_msdyn.training.config import MixedViewsConfig
from lerobot_msdyn.training.live import LiveScene
from lerobot_msdyn.training.matching import scenes_of, settings_of
from lerobot_msdyn.training.scene_cache import SceneCache, Scenes
from lerobot_msdyn.views.camera_change import sample_change
from lerobot_msdyn.views.coverage import HOLE_ALPHA

FACTORS = (1.0, 0.5, 0.25)  # of a change, until little enough of the picture is empty


class ViewMixer:
    """New views of a dataset's samples."""

    def __init__(
        self,
        meta: LeRobotDatasetMetadata,
        episodes: list[int] | None,
        deltas: dict[str, list[int]],
        scenes: str | os.PathLike[str] | Scenes,
        probability: float,
        perturbation: Perturbation | None,
        seed: int,
        memory_mb: float,
    ) -> None:
        """See `MixedViews`; `deltas` are the observation windows of the cameras, in frames.

        Raises:
            ConfigError: a value is out of range, or the perturbation cannot be used here.
            MsdynError: there are no scenes, or they are of other videos.
        """
        wrong = problems(MixedViewsConfig(probability=probability, seed=seed, memory_mb=memory_mb))
        if wrong:
            raise ConfigError("; ".join(wrong))
        if isinstance(scenes, str | os.PathLike):
            scenes = output_folder(Path(scenes))
        self.probability, self.seed, self.deltas = probability, seed, deltas
        self.perturbation, self.max_empty = settings_of(scenes, perturbation)
        check_pose(self.perturbation)
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
        """The cameras of a sample that are to be rendered in this epoch; none, if it stays as recorded."""
        if np.random.default_rng([self.seed, self.epoch, index]).random() >= self.probability:
            return []
        return sorted(self.cache.scenes.get(episode, ()))

    def render(self, episode: int, position: int, index: int, cameras: list[str]) -> dict[str, np.ndarray]:
        """The windows of some cameras and of their depth (if recorded), by feature; each through one new pose.

        The epochs of a sample are stratified as the variants of an episode are. Of changes that differ from frame to
        frame the one at the sample's own is taken. A pose from which more than `max_empty` of a picture shows nothing
        is brought half as far, and again. Colours are uint8 [t,3,h,w], depth float32 [t,h,w] in m.

        Args:
            episode: of the dataset.
            position: frame in the episode.
            index: in the whole dataset.
            cameras: from `replaced`.
        """
        live = {camera: self.cache.get(episode, camera) for camera in cameras}
        scenes = {camera: one.scene for camera, one in live.items()}
        change = sample_change(self.perturbation, scenes, self.seed, index, self.epoch).at(position)
        for factor in FACTORS:
            pictures: dict[str, np.ndarray] = {}
            emptiest = 0.0
            for camera, seen_from in change.cameras(factor).items():
                windows, empty = self._windows(live[camera], seen_from, camera, position, episode)
                pictures |= windows
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
        rendered = live.render(seen_from.select(frames), frames)
        pictures = {camera: rendered.rgb[places[: len(colour)]]}
        if depth_key is not None:
            pictures[depth_key] = rendered.depth[places[len(colour) :]]
        return pictures, float((rendered.alpha < HOLE_ALPHA).mean((1, 2)).max())


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
