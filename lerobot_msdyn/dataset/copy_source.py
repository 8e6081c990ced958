"""Recorded pictures for the output, not encoded again: one episode cut out of the source's files and checked.

The counterpart of `encode`, which takes rendered pictures.
"""

import logging
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
    find_frames,
    read_colour,
    read_depth,
)
from lerobot_msdyn.dataset.rows import KEPT_S, off_grid_s, read_rows
from lerobot_msdyn.dataset.video import cut_video, encoder_of, problem_of

logger = logging.getLogger(__name__)


def stage_copies(source: LeRobotDatasetMetadata, index: int, keys: list[str], folder: Path) -> StagedPictures:
    """The pictures of some features as the source has them; those of image features stay in its rows.

    Raises:
        EpisodeError: a file is absent, damaged, or not what the metadata says.
    """
    rows = read_rows(source, index)
    off_s = off_grid_s(rows, source.fps)
    if off_s > KEPT_S:
        logger.warning(
            "%s episode %d: timestamps are up to %.4f s off frame_index / fps; pictures are taken by their number, and "
            "the new timestamps are frame_index / fps",
            source.repo_id,
            index,
            off_s,
        )
    folder.mkdir(parents=True, exist_ok=True)
    return StagedPictures(
        videos={key: _cut(source, index, key, rows, folder / f"{key}.mp4") for key in keys if key in source.video_keys},
        stats={key: _stats(source, index, key, rows) for key in keys},
    )


def _cut(source: LeRobotDatasetMetadata, index: int, key: str, rows: pa.Table, path: Path) -> Path:
    """One episode's part of a video file."""
    video, numbers = find_frames(source, index, key, rows)
    where, height, width = f"{source.repo_id} episode {index}, {key}", *picture_size(source.features[key])[:2]
    with whole_file(path) as part:
        try:
            cut_video(video, numbers, source.fps, lambda: encoder_of(source.features[key], key), part)
        except EpisodeError as error:
            raise EpisodeError(f"{where}: {error}") from error
        problem = problem_of(part, len(numbers), source.fps, (width, height))
    if problem is not None:
        raise EpisodeError(f"{where}: {video.path} cannot be copied: {problem}")
    return path


def _stats(source: LeRobotDatasetMetadata, index: int, key: str, rows: pa.Table) -> dict[str, np.ndarray]:
    """Statistics of one feature's pictures, from sampled frames."""
    chosen = sample_indices(rows.num_rows)
    if key in source.depth_keys:
        depth, _ = read_depth(source, index, key, rows, chosen)
        samples = depth[:, None].numpy() * depth_units_per_metre(source, key)
        return image_stats(np.stack([auto_downsample_height_width(sample) for sample in samples]), 1.0)
    channels = picture_size(source.features[key])[2] if key in source.image_keys else 3
    frames = read_colour(source, index, key, rows, chosen).numpy()
    pictures = [np.atleast_3d(with_channels(frame, channels)).transpose(2, 0, 1) for frame in frames]
    return image_stats(np.stack([auto_downsample_height_width(picture) for picture in pictures]))
