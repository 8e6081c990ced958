"""Read LeRobot episodes into plain tensors: pixels, cameras, recorded depth, state and action."""

import io
import logging
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import pyarrow as pa
import torch
from jaxtyping import Float, UInt8
from lerobot.configs import DepthEncoderConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.depth_utils import dequantize_depth
from lerobot.utils.constants import ACTION, HF_LEROBOT_HOME, OBS_STATE
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import CameraConfig
from lerobot_msdyn.core.errors import DatasetError, EpisodeError, first_line
from lerobot_msdyn.core.files import cache_folder, check_root
from lerobot_msdyn.core.observations import RobotSeen, View
from lerobot_msdyn.dataset.calibration import make_camera, read_robot
from lerobot_msdyn.dataset.checks import IntactEpisodes, check_metadata, check_version, picture_size
from lerobot_msdyn.dataset.chroma import is_subsampled, with_chroma
from lerobot_msdyn.dataset.features import completed
from lerobot_msdyn.dataset.named import check_named, no_dataset
from lerobot_msdyn.dataset.pose_columns import ORIGIN, WORLD, posed_by_column
from lerobot_msdyn.dataset.rows import TIMESTAMP_TOLERANCE_S, on_grid, read_rows, source_file, task_of, values_of
from lerobot_msdyn.dataset.video_index import (
    VIDEO_ERRORS,
    VideoIndex,
    decoded,
    episodes_in_file,
    frame_numbers,
    index_of,
)
from lerobot_msdyn.robots import load_robot
from lerobot_msdyn.robots.seen import robot_seen

logger = logging.getLogger(__name__)

MILLIMETRES = 1000.0


@dataclass(frozen=True)
class EpisodeSource:
    """Where an episode came from."""

    repo_id: str
    root: Path
    index: int


@dataclass(frozen=True)
class Episode:
    """One recorded episode; the views are those that were asked for."""

    source: EpisodeSource
    fps: int | float
    time: Float[Tensor, " t"]  # s since the episode's start
    views: dict[str, View]
    state: Float[Tensor, "t s"] | None
    action: Float[Tensor, "t a"] | None
    task: str

    def __len__(self) -> int:
        return self.time.shape[0]


class Source(LeRobotDatasetMetadata):
    """The metadata of a dataset that is read."""

    tolerance_s: float = TIMESTAMP_TOLERANCE_S  # how far a frame may be from its row's time, as LeRobotDataset has it
    handed_on: dict[tuple[int, str], UInt8[Tensor, "t h w 3"]]  # whole videos, each for who reads it next


def open_source(
    repo_id: str, root: Path | None = None, tolerance_s: float = TIMESTAMP_TOLERANCE_S
) -> LeRobotDatasetMetadata:
    """The metadata of a dataset in `root`, else in LeRobot's home, else on the hub. Nothing is written to `root`.

    Of a dataset that a killed recorder left, it is that of the leading episodes that are there, with a warning.
    Features lack nothing that LeRobot's trainer asks for (`features.completed`).

    Args:
        repo_id: the dataset's name.
        root: its folder.
        tolerance_s: how far a video frame may be from its row's time where rows and frames are not as many, s.

    Raises:
        DatasetError: there is no such dataset, it is not of version v3.0, or its metadata is not what it should be.
    """
    folder = HF_LEROBOT_HOME / repo_id if root is None else root
    if not (folder / "meta" / "info.json").exists():
        if root is not None:
            check_root(root)
        folder = _from_hub(repo_id)
    check_version(folder)
    intact = check_metadata(folder)
    try:
        source = _without_unfinished(repo_id, folder, intact) if intact.unfinished else Source(repo_id, folder)
    except Exception as error:  # several libraries read the metadata, each with errors of its own
        raise DatasetError(f"{folder}: the dataset's meta/ cannot be read ({first_line(error)})") from error
    if intact.count < intact.listed:
        logger.warning("%s", intact.lost_line(folder))
        source.info.total_episodes, source.info.total_frames = intact.count, intact.frames
    for key, feature in source.features.items():
        source.features[key] = completed(feature)
    source.tolerance_s, source.handed_on = tolerance_s, {}
    return source


def _without_unfinished(repo_id: str, folder: Path, intact: IntactEpisodes) -> Source:
    """The metadata of a dataset some of whose tables of episodes have no footer, over which LeRobot would stumble."""
    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary)
        names = [path.relative_to(folder) for path in (folder / "meta").iterdir() if path.is_file()]
        for name in [*names, *(path.relative_to(folder) for path in intact.files)]:
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(folder / name, copy / name)
        source = Source(repo_id, copy)
    source.root = folder
    return source


def _from_hub(repo_id: str) -> Path:
    """Where LeRobot put a dataset that it downloaded."""
    check_named(repo_id)
    try:
        return LeRobotDatasetMetadata(repo_id).root
    except Exception as error:
        raise no_dataset(repo_id, error) from error


def read_episode(
    meta: LeRobotDatasetMetadata, index: int, cameras: list[str], config: CameraConfig, *, recorded_depth: bool = True
) -> Episode:
    """One episode with the views of `cameras`, at full size.

    Raises:
        EpisodeError: a file of the episode is absent or damaged.
        ConfigError: `camera.pose_columns` names what the dataset does not have.
        PriorError: the calibration file cannot be used.
    """
    rows = read_rows(meta, index)
    time = torch.from_numpy(on_grid(rows, meta.fps)["timestamp"].to_numpy().astype(np.float32))
    state = _matrix(rows, OBS_STATE)
    views = {}
    for key in cameras:
        rgb = read_colour(meta, index, key, rows)
        depth, depth_range = None, (0.0, float("inf"))
        depth_key = depth_key_of(meta, key)
        if recorded_depth and depth_key is not None:
            depth, depth_range = read_depth(meta, index, depth_key, rows)
            if depth.shape != rgb.shape[:3]:
                raise EpisodeError(
                    f"{meta.repo_id} episode {index}: {depth_key} is {tuple(depth.shape[1:])}, "
                    f"its camera {tuple(rgb.shape[1:3])}; "
                    "only depth that is aligned to the colour image can be used (--priors.depth plane goes without)"
                )
        camera = make_camera(key, index, rgb, config)
        poses = posed_by_column(meta, key, index, config, lambda column: values_of(rows, column, meta.features[column]))
        if poses is not None:
            camera = replace(camera, world_from_camera=poses, origin=ORIGIN, world=WORLD)
        robot = _robot(config, camera, state, meta.fps)
        views[key] = View(rgb, camera, depth, depth_range, robot)
    return Episode(
        source=EpisodeSource(meta.repo_id, meta.root, index),
        fps=meta.fps,
        time=time - time[0],
        views=views,
        state=state,
        action=_matrix(rows, ACTION),
        task=task_of(meta, rows),
    )


def _robot(
    config: CameraConfig, camera: CameraTrack, state: Float[Tensor, "t s"] | None, fps: int | float
) -> RobotSeen | None:
    """What a calibrated camera sees of the robot, where the calibration names one."""
    if config.calibration is None or camera.origin != "calibration" or state is None:
        return None
    record = read_robot(config.calibration)
    if record is None:
        return None
    robot = load_robot(record.urdf, record.licence, cache_folder("robots"))
    return robot_seen(robot, record, state, fps, camera, config.calibration)


def depth_key_of(meta: LeRobotDatasetMetadata, camera: str) -> str | None:
    """The feature that holds the recorded depth of a colour camera, if there is one (`<camera>_depth`)."""
    return next((key for key in meta.depth_keys if key == f"{camera}_depth"), None)


def read_colour(
    meta: LeRobotDatasetMetadata, index: int, key: str, rows: pa.Table, frames: Sequence[int] | None = None
) -> UInt8[Tensor, "t h w 3"]:
    """Frames of one colour camera; chroma that was recorded at half the size is restored (`chroma`).

    Args:
        meta: the dataset.
        index: the episode.
        key: feature key of the camera.
        rows: all rows of the episode.
        frames: which frames, ascending; default: all.

    Raises:
        EpisodeError: a frame is absent or cannot be decoded.
    """
    if frames is None and isinstance(meta, Source) and (index, key) in meta.handed_on:
        return meta.handed_on.pop((index, key))
    if key in meta.video_keys:
        return _decode_video(meta, index, key, rows, frames)
    images = [_decode_image(meta, index, key, item, cv2.IMREAD_COLOR_RGB) for item in _images(rows, key, frames)]
    return torch.from_numpy(np.stack(images))


def hand_on(meta: LeRobotDatasetMetadata, index: int, key: str, rgb: UInt8[Tensor, "t h w 3"]) -> None:
    """Spare the next one who reads all frames of a colour camera from decoding them again."""
    if isinstance(meta, Source):
        meta.handed_on[index, key] = rgb


def hand_on_nothing(meta: LeRobotDatasetMetadata) -> None:
    """Forget what was handed on: others read it, in processes of their own."""
    if isinstance(meta, Source):
        meta.handed_on.clear()


def read_depth(
    meta: LeRobotDatasetMetadata, index: int, key: str, rows: pa.Table, frames: Sequence[int] | None = None
) -> tuple[Float[Tensor, "t h w"], tuple[float, float]]:
    """Frames of one recorded depth camera in metres, and the range whose ends mean "not measured"; as `read_colour`.

    Raises:
        EpisodeError: a frame is absent or cannot be decoded.
    """
    if key in meta.video_keys:
        encoder = _depth_encoder(meta, key)

        def in_metres(block: Tensor) -> Tensor:
            depth = dequantize_depth(
                block,
                depth_min=encoder.depth_min,
                depth_max=encoder.depth_max,
                shift=encoder.shift,
                use_log=encoder.use_log,
                output_unit="m",
            )
            return depth[:, 0].float()

        depth = _decode_video(meta, index, key, rows, frames, in_metres)
        return depth, (encoder.depth_min, encoder.depth_max)
    images = [_decode_image(meta, index, key, item, cv2.IMREAD_UNCHANGED) for item in _images(rows, key, frames)]
    depth = torch.from_numpy(np.stack(images).astype(np.float32))
    return depth / depth_units_per_metre(meta, key), (0.0, float("inf"))


def _depth_encoder(meta: LeRobotDatasetMetadata, key: str) -> DepthEncoderConfig:
    try:
        return DepthEncoderConfig.from_video_info(meta.features[key].get("info") or {})
    except (ValueError, TypeError) as error:
        raise EpisodeError(
            f"{meta.repo_id}: {key} cannot be read with the settings in its info ({first_line(error)})"
        ) from error


def find_frames(meta: LeRobotDatasetMetadata, index: int, key: str, rows: pa.Table) -> tuple[VideoIndex, list[int]]:
    """The file in which the frames of one episode of a camera lie, and their numbers in it.

    Raises:
        EpisodeError: it is absent, cannot be read, is of another size, or does not hold one frame per row.
    """
    where = f"{meta.repo_id} episode {index}, {key}"
    path = source_file(meta, index, meta.get_video_file_path(index, key))
    height, width, _ = picture_size(meta.features[key])
    tolerance_s = meta.tolerance_s if isinstance(meta, Source) else TIMESTAMP_TOLERANCE_S
    try:
        video = index_of(path)
        if video.size != (width, height):
            raise DatasetError(
                f"{path} is {video.size[0]}x{video.size[1]}; meta/info.json says {width}x{height}: correct its shape"
            )
        placed, times = episodes_in_file(meta, index, key), rows["timestamp"].to_numpy().astype(np.float64)
        return video, frame_numbers(video, placed, index, times, meta.fps, tolerance_s)
    except DatasetError as error:
        raise EpisodeError(f"{where}: {error}") from error
    except VIDEO_ERRORS as error:
        raise EpisodeError(f"{where}: {path} cannot be decoded ({first_line(error)})") from error


def _decode_video(
    meta: LeRobotDatasetMetadata,
    index: int,
    key: str,
    rows: pa.Table,
    chosen: Sequence[int] | None,
    in_metres: Callable[[Tensor], Tensor] | None = None,
) -> Tensor:
    """Frames of a video: colours [t,h,w,3], or what is made of the depth codes of one [1,1,h,w].

    Worked on as they are decoded, so that a video is in memory once.
    """
    video, numbers = find_frames(meta, index, key, rows)
    if chosen is not None:
        numbers = [numbers[frame] for frame in chosen]
    pictures: Iterator[np.ndarray] = decoded(video, numbers, is_depth=in_metres is not None)
    if in_metres is None and is_subsampled(video.pix_fmt):
        pictures = with_chroma(pictures)
    frames: Tensor | None = None
    try:
        for place, picture in enumerate(pictures):
            frame = torch.from_numpy(picture)
            if in_metres is not None:
                frame = in_metres(frame[None, None])[0]
            if frames is None:
                frames = frame.new_empty(len(numbers), *frame.shape)
            frames[place] = frame
    except (*VIDEO_ERRORS, TypeError) as error:  # TypeError: settings of the depth's codes
        raise EpisodeError(
            f"{meta.repo_id} episode {index}, {key}: {video.path} cannot be decoded for all of its {len(numbers)} "
            f"frames ({first_line(error)})"
        ) from error
    if frames is None:
        raise EpisodeError(f"{meta.repo_id} episode {index}, {key}: the episode has no frames")
    return frames


def _images(rows: pa.Table, key: str, frames: Sequence[int] | None) -> list[Any]:
    """What the rows of some frames hold of an image feature."""
    return list((rows if frames is None else rows.take(list(frames)))[key].to_pylist())


def _decode_image(meta: LeRobotDatasetMetadata, index: int, key: str, item: Any, flags: int) -> np.ndarray:
    """One image of an image feature: the bytes in the parquet row, else the file that it names inside the dataset."""
    where = f"{meta.repo_id} episode {index}, {key}"
    content, name = (item or {}).get("bytes"), (item or {}).get("path")
    if content is None:
        if not name:
            raise EpisodeError(f"{where}: a frame has no image")
        content = source_file(meta, index, Path(name)).read_bytes()
    height, width, _ = picture_size(meta.features[key])
    try:
        with PIL.Image.open(io.BytesIO(content)) as header:
            size = header.size
    except (OSError, ValueError, SyntaxError, PIL.Image.DecompressionBombError) as error:
        raise EpisodeError(f"{where}: an image of {len(content)} bytes cannot be decoded") from error
    if size != (width, height):
        raise EpisodeError(
            f"{where}: an image is {size[0]}x{size[1]}; meta/info.json says {width}x{height}: correct its shape"
        )
    image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    if image is None:
        raise EpisodeError(f"{where}: an image of {len(content)} bytes cannot be decoded")
    return image


def depth_units_per_metre(meta: LeRobotDatasetMetadata, key: str) -> float:
    """How many of the units in which a depth feature was recorded make a metre (LeRobot's default: millimetres)."""
    return 1.0 if (meta.features[key].get("info") or {}).get("depth_unit") == "m" else MILLIMETRES


def _matrix(rows: pa.Table, key: str) -> Float[Tensor, "t n"] | None:
    if key not in rows.column_names:
        return None
    values = np.stack([np.atleast_1d(np.asarray(item, np.float32)) for item in rows[key].to_pylist()])
    return torch.from_numpy(values)
