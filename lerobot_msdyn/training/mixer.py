"""Decides which samples are seen from elsewhere, and draws them: a function of (seed, epoch, index) alone."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Int, UInt8
from lerobot.configs import DepthEncoderConfig
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_msdyn.cameras import CameraTrack
from lerobot_msdyn.config import MixedViewsConfig, PerturbationConfig, problems
from lerobot_msdyn.episode import MILLIMETRES, depth_key_of
from lerobot_msdyn.errors import ConfigError
from lerobot_msdyn.perturbation import draw_offset, perturb
from lerobot_msdyn.saved import SavedScene
from lerobot_msdyn.training.cache import SceneCache, Scenes
from lerobot_msdyn.training.matching import perturbation_of, scenes_of

_STREAM = 0x4D56  # keeps these random numbers apart from those of written episodes


class ViewMixer:
    """New views of a dataset's samples."""

    def __init__(
        self,
        meta: LeRobotDatasetMetadata,
        episodes: list[int] | None,
        deltas: dict[str, list[int]],
        scenes: Path | Scenes,
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
        self.probability, self.seed, self.deltas = probability, seed, deltas
        self.perturbation = perturbation_of(scenes) if perturbation is None else perturbation
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

    def rng(self, index: int) -> np.random.Generator:
        """The random numbers of a sample in this epoch, by its index in the whole dataset."""
        return np.random.default_rng([_STREAM, self.seed, self.epoch, index])

    def replaced(self, episode: int, rng: np.random.Generator) -> list[str]:
        """The cameras to be drawn; none, if the sample stays as recorded."""
        if rng.random() >= self.probability:
            return []
        return sorted(self.cache.scenes.get(episode, ()))

    def draw(self, episode: int, position: int, cameras: list[str], rng: np.random.Generator) -> dict[str, np.ndarray]:
        """The windows of some cameras and of their depth (if recorded), by feature; each through one new pose.

        Colours are uint8 [t,3,h,w], depth float32 [t,h,w] in m.

        Args:
            episode: of the dataset.
            position: frame in the episode.
            cameras: from `replaced`.
            rng: from `rng`, after `replaced`.
        """
        pictures: dict[str, np.ndarray] = {}
        for camera in cameras:
            live, depth_key = self.cache.get(episode, camera), self.depth_keys[camera]
            colour = [position + delta for delta in self.deltas.get(camera, [0])]
            depth = [] if depth_key is None else [position + delta for delta in self.deltas.get(depth_key, [0])]
            within = np.clip(colour + depth, 0, self._lengths[episode] - 1)
            wanted, places = np.unique(within, return_inverse=True)
            frames = torch.from_numpy(wanted)
            drawn = live.draw(new_camera(self.perturbation, live.scene, frames, rng), frames)
            pictures[camera] = drawn.rgb[places[: len(colour)]]
            if depth_key is not None:
                pictures[depth_key] = drawn.depth[places[len(colour) :]]
        return pictures


def new_camera(
    config: PerturbationConfig, scene: SavedScene, frames: Int[Tensor, " t"], rng: np.random.Generator
) -> CameraTrack:
    """One camera change for some frames of a scene."""
    offset, _ = draw_offset(config, scene.distance, rng)
    return perturb(scene.camera.select(frames), offset)


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
