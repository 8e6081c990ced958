"""A LeRobot dataset, some of whose samples are seen from elsewhere."""

import copy
import os
from typing import Any, overload

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.core.perturbation import Perturbation
from lerobot_msdyn.core.processes import cores
from lerobot_msdyn.render.cpu.threads import begun
from lerobot_msdyn.training.config import MixedViewsConfig
from lerobot_msdyn.training.mixer import ViewMixer, colour_sample, depth_sample
from lerobot_msdyn.training.scene_cache import Scenes


class MixedViews(torch.utils.data.Dataset):
    """Wraps a LeRobotDataset; with some probability a sample's pictures are rendered from the episode's saved scene.

    One new pose per camera holds for the whole observation window; cameras without a scene, states, actions and all
    else are as recorded, also columns that say where the camera was. What a sample is depends on (seed, epoch, index)
    alone, not on workers or order. Everything that this class does not define (`meta`, `episodes`, `num_frames`, ...)
    is the wrapped dataset's.
    """

    def __init__(
        self,
        dataset: LeRobotDataset,
        scenes: str | os.PathLike[str] | Scenes,
        probability: float = MixedViewsConfig.probability,
        perturbation: Perturbation | None = None,
        seed: int = MixedViewsConfig.seed,
        *,
        memory_mb: float = MixedViewsConfig.memory_mb,
    ) -> None:
        """Nothing is rendered or loaded yet.

        Args:
            dataset: the dataset from which the scenes were made, or the output of that run.
            scenes: the output of `augment --save_scenes true`, a folder or a name, or episode -> camera -> its scene.
            probability: share of the samples that are seen from elsewhere.
            perturbation: how cameras are moved; default: as in the run that saved the scenes.
            seed: of all random choices.
            memory_mb: bound for the scenes that are kept loaded, in each process.

        Raises:
            ConfigError: a value is out of range, or the perturbation is not known here.
            MsdynError: there are no scenes, or they are of other videos.
        """
        self.dataset = dataset
        deltas = {
            key: [round(delta * dataset.fps) for delta in window]
            for key, window in (dataset.delta_timestamps or {}).items()
        }
        self.mixer = ViewMixer(
            dataset.meta, dataset.episodes, deltas, scenes, probability, perturbation, seed, memory_mb
        )
        self._starts = np.asarray(dataset.meta.episodes["dataset_from_index"], np.int64)
        chosen = dataset.absolute_to_relative_idx
        self._absolute = None if chosen is None else np.fromiter(chosen, np.int64, len(chosen))

    def __getattr__(self, name: str) -> Any:
        """All else is the wrapped dataset's."""
        if name == "dataset":  # asked for while a copy is being unpickled
            raise AttributeError(name)
        return getattr(self.dataset, name)

    def __len__(self) -> int:
        return len(self.dataset)

    def set_epoch(self, epoch: int) -> None:
        """Tell it, and workers that run already, which epoch it is; from then on samples are seen from elsewhere."""
        self.mixer.set_epoch(epoch)

    @overload
    def __getitem__(self, index: int) -> dict[str, Any]: ...
    @overload
    def __getitem__(self, index: slice) -> list[dict[str, Any]]: ...
    def __getitem__(self, index: int | slice) -> dict[str, Any] | list[dict[str, Any]]:
        """One sample, or those of a slice."""
        if isinstance(index, slice):
            return [self._sample(i) for i in range(*index.indices(len(self)))]
        return self._sample(range(len(self))[index])

    def __getitems__(self, indices: list[int]) -> list[dict[str, Any]]:
        """The samples of a batch, as a data loader asks for them.

        In a loader's worker, new views are rendered beside the reading of recorded samples, where there are more cores
        than workers.
        """
        samples = [range(len(self))[index] for index in indices]
        replaced = {index: self._replaced(index) for index in samples}
        rendered = [index for index, (_, _, cameras) in replaced.items() if cameras]
        helpers = _free_cores()
        if helpers == 0 or not rendered:
            return [self._sample(index) for index in samples]
        pictures = dict(zip(rendered, begun(self._pictures, rendered, helpers), strict=True))
        read = {index: dict(self.dataset[index]) for index in replaced if index not in pictures}
        for index in reversed(rendered):
            read[index] = with_pictures(self.dataset, index, pictures[index](), self.mixer)
        return [read[index] for index in samples]

    def _sample(self, index: int) -> dict[str, Any]:
        if not self._replaced(index)[2]:
            return dict(self.dataset[index])
        return with_pictures(self.dataset, index, self._pictures(index), self.mixer)

    def _replaced(self, index: int) -> tuple[int, int, list[str]]:
        """Of a sample: its place in the whole dataset, its episode, and which of its cameras are rendered."""
        absolute = index if self._absolute is None else int(self._absolute[index])
        episode = int(np.searchsorted(self._starts, absolute, side="right")) - 1
        return absolute, episode, self.mixer.replaced(episode, absolute)

    def _pictures(self, index: int) -> dict[str, np.ndarray]:
        """The rendered ones of a sample."""
        absolute, episode, cameras = self._replaced(index)
        return self.mixer.render(episode, absolute - int(self._starts[episode]), absolute, cameras)


def _free_cores() -> int:
    """Cores of this process's share in which nothing runs yet, where it is one of a data loader's workers."""
    worker = torch.utils.data.get_worker_info()
    return 0 if worker is None else max(0, cores() // worker.num_workers - 1)


def with_pictures(
    dataset: LeRobotDataset, index: int, pictures: dict[str, np.ndarray], mixer: ViewMixer
) -> dict[str, Any]:
    """A dataset's sample with other pictures in it, transformed as the dataset's own are."""
    meta = dataset.meta
    item = _read(dataset, index, pictures.keys() & set(meta.video_keys))
    for key, picture in pictures.items():
        windowed = _is_windowed(dataset, key, mixer)
        if key in meta.depth_keys:
            item[key] = depth_sample(picture, meta, key, dataset.depth_output_unit, windowed=windowed)
        else:
            as_bytes = key in meta.video_keys and dataset._return_uint8
            item[key] = colour_sample(picture, torch.uint8 if as_bytes else torch.float32, windowed=windowed)
    if dataset.image_transforms is not None:
        for key in meta.camera_keys:
            if key not in meta.depth_keys:
                item[key] = dataset.image_transforms(item[key])
    return item


def _is_windowed(dataset: LeRobotDataset, key: str, mixer: ViewMixer) -> bool:
    """Whether a sample holds a window of a feature: LeRobot drops the window of one frame of a video, not of images."""
    window = mixer.deltas.get(key)
    return window is not None and (len(window) > 1 or key not in dataset.meta.video_keys)


def _read(dataset: LeRobotDataset, index: int, undecoded: set[str]) -> dict[str, Any]:
    """The recorded sample before image transforms, without the videos of some features.

    LeRobot's reader has no such option: in a copy of it the method that decodes is replaced. Without that method all
    videos are decoded, and the sample is the same.
    """
    reader = copy.copy(dataset.reader)
    reader.set_image_transforms(None)
    decode = getattr(reader, "_query_videos", None)
    if decode is not None:

        def decode_others(timestamps: dict[str, list[float]], episode: int) -> dict[str, Any]:
            wanted = {key: times for key, times in timestamps.items() if key not in undecoded}
            return decode(wanted, episode) | dict.fromkeys(undecoded)

        reader._query_videos = decode_others
    return dict(reader.get_item(index))
