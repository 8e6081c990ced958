"""Rendered pictures for the output: encoded as they come, all cameras in step, and read again before they count.

The counterpart of `copy_source`, which takes recorded pictures.
"""

import shutil
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import av
import cv2
import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.compute_stats import auto_downsample_height_width, get_feature_stats, sample_indices

from lerobot_msdyn.core.errors import EpisodeError, OutputError, first_line
from lerobot_msdyn.core.files import writing
from lerobot_msdyn.dataset.checks import picture_size
from lerobot_msdyn.dataset.read import depth_units_per_metre
from lerobot_msdyn.dataset.video import VideoFile, encoder_of, nvenc_of, problem_of

Stats = dict[str, dict[str, np.ndarray]]

OPAQUE = 255
CHECKED_FRAMES = 3
AHEAD = 16  # times that may be rendered before they are encoded; it bounds the memory


@dataclass(frozen=True)
class StagedPictures:
    """Where the pictures of an episode lie, by feature, and their statistics."""

    videos: dict[str, Path] = field(default_factory=dict)  # mp4 files
    images: dict[str, Path] = field(default_factory=dict)  # folders of one file per frame
    stats: Stats = field(default_factory=dict)


def stage_pictures(
    source: LeRobotDatasetMetadata,
    folder: Path,
    frames: Iterable[Mapping[str, np.ndarray]],
    length: int,
    *,
    nvenc: bool = False,
) -> StagedPictures:
    """Encode the frames of an episode as their features are encoded in the source, and decode them again.

    Frames are encoded in a thread, while the next ones are rendered.

    Args:
        source: the dataset whose features they are.
        folder: where to put them; what lies there is removed.
        frames: per time, feature -> colours uint8 [h,w,3], or depth float32 [h,w] in m (0 = unknown).
        length: how many frames there must be.
        nvenc: whether a GPU encodes videos where it can (see `nvenc_of`).

    Raises:
        OutputError: there are more or fewer, the source's video codec cannot be written here, or the disk is full.
    """
    writers: dict[str, _FeatureWriter] = {}

    def encode(pictures: Mapping[str, np.ndarray]) -> None:
        for key, picture in pictures.items():
            if key not in writers:
                writers[key] = _FeatureWriter(source, key, folder, length, nvenc=nvenc)
            writers[key].add(picture)

    with writing(folder):
        shutil.rmtree(folder, ignore_errors=True)
        try:
            count = _meanwhile(encode, frames)
        finally:
            for writer in writers.values():
                writer.close()
    if count != length:
        raise OutputError(f"{folder}: {count} frames were rendered; expected {length}")
    for writer in writers.values():
        writer.check(length)
    return StagedPictures(
        videos={key: writer.path for key, writer in writers.items() if key in source.video_keys},
        images={key: writer.path for key, writer in writers.items() if key not in source.video_keys},
        stats={key: writer.stats() for key, writer in writers.items()},
    )


def check_encoding(source: LeRobotDatasetMetadata, keys: Sequence[str], folder: Path, *, nvenc: bool = False) -> None:
    """Encode a few frames of some features and decode them again.

    Raises:
        OutputError: that is not possible here, or gives other pictures.
    """
    for key in keys:
        height, width, _ = picture_size(source.features[key])
        shades = np.linspace(0, 255, width).astype(np.uint8)
        colours = np.broadcast_to(shades[None, :, None], (height, width, 3))
        picture = np.ones((height, width), np.float32) if key in source.depth_keys else colours
        try:
            stage_pictures(source, folder, [{key: picture}] * CHECKED_FRAMES, CHECKED_FRAMES, nvenc=nvenc)
        except (av.FFmpegError, ValueError, RuntimeError) as error:
            raise OutputError(
                f"{source.repo_id}: new videos of {key} cannot be encoded as the source's are ({first_line(error)}); "
                f"choose other --cameras, or another codec or pixel format in the info of {key} in meta/info.json"
            ) from error


def _meanwhile[T](work: Callable[[T], None], items: Iterable[T]) -> int:
    """Do the work on each item, in order, in a thread, while the next items are made; returns how many there were."""
    count, waiting = 0, deque[Future[None]]()
    with ThreadPoolExecutor(1, "encoder") as thread:
        for item in items:
            waiting.append(thread.submit(work, item))
            count += 1
            if len(waiting) > AHEAD:
                waiting.popleft().result()
        for future in waiting:
            future.result()
    return count


class _FeatureWriter:
    """One feature's pictures: an mp4 file, or a folder of image files; and the samples for their statistics."""

    def __init__(self, source: LeRobotDatasetMetadata, key: str, folder: Path, length: int, *, nvenc: bool) -> None:
        self._unit = depth_units_per_metre(source, key)
        self._is_depth = key in source.depth_keys
        self._channels = picture_size(source.features[key])[2]
        self._wanted = set(sample_indices(length))
        self._samples: list[np.ndarray] = []
        self._levels: list[float] = []
        self._size = (0, 0)
        self._count = 0
        self._fps = source.fps
        self._video: VideoFile | None = None
        if key in source.video_keys:
            self.path = folder / f"{key}.mp4"
            encoder = encoder_of(source.features[key], key)
            self._video = VideoFile(self.path, source.fps, nvenc_of(encoder) if nvenc else encoder)
        else:
            self.path = folder / key
            self.path.mkdir(parents=True)

    def add(self, picture: np.ndarray) -> None:
        self._size = (picture.shape[1], picture.shape[0])
        if self._video is None and not self._is_depth:
            picture = with_channels(picture, self._channels)
        if self._count in self._wanted:
            sample = picture[None] * self._unit if self._is_depth else np.atleast_3d(picture).transpose(2, 0, 1)
            self._samples.append(auto_downsample_height_width(sample))
        if self._video is not None:
            if not self._is_depth:
                self._levels.append(float(picture.mean()))
            self._video.add(picture)
        else:
            stored = _in_stored_unit(picture, self._unit) if self._is_depth else picture
            suffix = ".tiff" if self._is_depth else ".png"
            (self.path / f"frame-{self._count:06d}{suffix}").write_bytes(encode_image(stored, suffix))
        self._count += 1

    def close(self) -> None:
        if self._video is not None:
            self._video.close()

    def check(self, length: int) -> None:
        """Decode the video again; images are read as they are, byte for byte, and need none."""
        if self._video is None:
            return
        problem = problem_of(self.path, length, self._fps, self._size, self._levels or None)
        if problem is not None:
            raise OutputError(f"{self.path} was written but is not what was rendered: {problem}")

    def stats(self) -> dict[str, np.ndarray]:
        return image_stats(np.stack(self._samples), 1.0 if self._is_depth else 255.0)


def encode_image(image: np.ndarray, suffix: str) -> bytes:
    """An image file's content: colours uint8 [h,w,3] or [h,w,4], or grey or depth [h,w] as it is stored."""
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)
    ok, content = cv2.imencode(suffix, image)
    if not ok:
        raise EpisodeError(f"an image of shape {image.shape} cannot be encoded as {suffix}")
    return bytes(content.tobytes())


def with_channels(picture: np.ndarray, channels: int) -> np.ndarray:
    """Colours uint8 [h,w,3] as an image of 1 (grey, [h,w]), 3, or 4 channels (opaque)."""
    if channels == 1:
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
    if channels == 4:
        return np.dstack([picture, np.full(picture.shape[:2], OPAQUE, np.uint8)])
    return picture


def _in_stored_unit(depth: np.ndarray, unit: float) -> np.ndarray:
    """Depth in m as a depth camera records it: float32 metres, or uint16 in another unit."""
    return depth if unit == 1 else np.rint(depth * unit).clip(0, 65535).astype(np.uint16)


def image_stats(samples: np.ndarray, scale: float = 255.0) -> dict[str, np.ndarray]:
    """LeRobot's statistics per channel of sampled frames [n,c,h,w], divided by `scale`; shapes [c,1,1].

    Opacity has none: LeRobot accepts statistics of one or three channels.
    """
    stats = get_feature_stats(samples[:, :3], axis=(0, 2, 3), keepdims=True)
    return {name: value if name == "count" else np.squeeze(value / scale, axis=0) for name, value in stats.items()}
