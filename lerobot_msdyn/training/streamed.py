"""A streaming LeRobot dataset, some of whose samples are seen from elsewhere."""

import os
from collections.abc import Iterator
from typing import Any

import torch

from lerobot_msdyn.core.perturbation import Perturbation
from lerobot_msdyn.training.config import MixedViewsConfig
from lerobot_msdyn.training.mixer import ViewMixer, colour_sample, depth_sample
from lerobot_msdyn.training.scene_cache import Scenes


class MixedStream(torch.utils.data.IterableDataset):
    """As `MixedViews`, around a StreamingLeRobotDataset.

    The scenes must be on this machine, and recorded frames that are replaced have been decoded already: nothing is
    saved by streaming but the disk for the recording.
    """

    def __init__(
        self,
        dataset: Any,
        scenes: str | os.PathLike[str] | Scenes,
        probability: float = MixedViewsConfig.probability,
        perturbation: Perturbation | None = None,
        seed: int = MixedViewsConfig.seed,
        *,
        memory_mb: float = MixedViewsConfig.memory_mb,
    ) -> None:
        """Arguments and errors as in `MixedViews`, but `dataset` is a StreamingLeRobotDataset."""
        self.dataset = dataset
        self.mixer = ViewMixer(
            dataset.meta,
            dataset.episodes,
            dict(dataset.delta_indices or {}),
            scenes,
            probability,
            perturbation,
            seed,
            memory_mb,
        )

    def __getattr__(self, name: str) -> Any:
        """All else is the wrapped dataset's."""
        if name == "dataset":  # asked for while a copy is being unpickled
            raise AttributeError(name)
        return getattr(self.dataset, name)

    def set_epoch(self, epoch: int) -> None:
        """Tell it, and workers that run already, which epoch it is."""
        self.mixer.set_epoch(epoch)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for item in self.dataset:
            yield self._mixed(item)

    def _mixed(self, item: dict[str, Any]) -> dict[str, Any]:
        """A sample, seen from elsewhere if its turn has come."""
        episode, position, index = (int(item[key]) for key in ("episode_index", "frame_index", "index"))
        pictures = self.mixer.render(episode, position, index, self.mixer.replaced(episode, index))
        for key, picture in pictures.items():
            windowed = item[key].ndim == 4
            if key in self.dataset.meta.depth_keys:
                unit = self.dataset.depth_output_unit
                item[key] = depth_sample(picture, self.dataset.meta, key, unit, windowed=windowed)
            else:
                image = colour_sample(picture, item[key].dtype, windowed=windowed)
                transforms = self.dataset.image_transforms
                item[key] = image if transforms is None else transforms(image)
        return item
