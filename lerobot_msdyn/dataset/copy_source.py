"""Recorded pictures for the output, not encoded again: one episode cut out of the source's files and checked.

The counterpart of `encode`, which takes rendered pictures.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.compute_stats import auto_downsample_height_width, sample_indices

from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.core.files import whole_file
from lerobot_msdyn.dataset.checks import picture_size
from lerobot_msdyn.dataset.encode import StagedPictures, image_stats, with_channels
from lerobot_msdyn.dataset.read import (
    depth_units_per_metre,
    read_colour,
    read_depth,
)
from lerobot_msdyn.dataset.rows import read_rows, source_file
from lerobot_msdyn.dataset.video import cut_video, encoder_of, problem_of


def stage_copies(source: LeRobotDatasetMetadata, index: int, keys: list[str], folder: Path) -> StagedPictures:
    """The pictures of some features as the source has them; those of image features stay in its rows.

    Raises:
        EpisodeError: a file is absent, damaged, or not what the metadata says.
    """
    rows = read_rows(source, index)
    folder.mkdir(parents=True, exist_ok=True)
    return StagedPictures(
        videos={key: _cut(source, index, key, folder / f"{key}.mp4") for key in keys if key in source.video_keys},
        stats={key: _stats(source, index, key, rows) for key in keys},
    )


def _cut(source: LeRobotDatasetMetadata, index: int, key: str, path: Path) -> Path:
    """One episode's part of a video file."""
    episode = source.episodes[index]
    length = int(episode["length"])
    file = source_file(source, index, source.get_video_file_path(index, key))
    start = float(episode[f"videos/{key}/from_timestamp"])
    with whole_file(path) as part:
        try:
            cut_video(file, start, length, source.fps, encoder_of(source.features[key], key), part)
        except EpisodeError as error:
            raise EpisodeError(f"{source.repo_id} episode {index}, {key}: {error}") from error
        height, width, _ = picture_size(source.features[key])
        problem = problem_of(part, length, source.fps, (width, height))
    if problem is not None:
        raise EpisodeError(f"{source.repo_id} episode {index}, {key}: {file} cannot be copied: {problem}")
    return path


def _stats(source: LeRobotDatasetMetadata, index: int, key: str, rows: pa.Table) -> dict[str, np.ndarray]:
    """Statistics of one feature's pictures, from sampled frames."""
    chosen = sample_indices(rows.num_rows)
    if key in source.depth_keys:
        depth, _ = read_depth(source, index, key, rows)
        samples = depth[chosen][:, None].numpy() * depth_units_per_metre(source, key)
        return image_stats(np.stack([auto_downsample_height_width(sample) for sample in samples]), 1.0)
    channels = picture_size(source.features[key])[2] if key in source.image_keys else 3
    frames = read_colour(source, index, key, rows)[chosen].numpy()
    pictures = [np.atleast_3d(with_channels(frame, channels)).transpose(2, 0, 1) for frame in frames]
    return image_stats(np.stack([auto_downsample_height_width(picture) for picture in pictures]))
