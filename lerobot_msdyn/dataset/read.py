"""Read LeRobot episodes into plain tensors: pixels, cameras, recorded depth, state and action."""

import io
import logging
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import PIL.Image
import pyarrow as pa
import torch
from jaxtyping import Float, UInt8
from lerobot.configs import DepthEncoderConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.depth_utils import dequantize_depth
from lerobot.datasets.video_utils import decode_video_frames
from lerobot.utils.constants import ACTION, HF_LEROBOT_HOME, OBS_STATE
from torch import Tensor

from lerobot_msdyn.core.config import CameraConfig
from lerobot_msdyn.core.errors import DatasetError, EpisodeError, first_line
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.dataset.calibration import make_camera
from lerobot_msdyn.dataset.checks import IntactEpisodes, check_metadata, picture_size, read_json
from lerobot_msdyn.dataset.chroma import is_subsampled, restore_chroma
from lerobot_msdyn.dataset.features import completed
from lerobot_msdyn.dataset.rows import TIMESTAMP_TOLERANCE_S, read_rows, source_file, task_of

logger = logging.getLogger(__name__)

VIDEO_BACKEND = "pyav"
CODEBASE_VERSION = "v3.0"
# What a broken video can cause; AttributeError: a stream of an unknown codec has no context.
VIDEO_ERRORS = (av.FFmpegError, OSError, ValueError, RuntimeError, IndexError, AttributeError)
BLOCK_FRAMES = 128  # that are decoded at once
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


def open_source(repo_id: str, root: Path | None = None) -> LeRobotDatasetMetadata:
    """The metadata of a dataset in `root`, else in LeRobot's home, else on the hub. Nothing is written to `root`.

    Of a dataset that a killed recorder left, it is that of the leading episodes that are there, with a warning.
    Features lack nothing that LeRobot's trainer asks for (`features.completed`).

    Raises:
        DatasetError: there is no such dataset, it is not of version v3.0, or its metadata is not what it should be.
    """
    folder = HF_LEROBOT_HOME / repo_id if root is None else root
    if not (folder / "meta" / "info.json").exists():
        if root is not None:
            raise DatasetError(
                f"no dataset in {root}: {root / 'meta' / 'info.json'} is absent; "
                "--root is the exact folder that holds meta/, data/ and videos/"
            )
        folder = _from_hub(repo_id, folder)
    check_version(folder)
    intact = check_metadata(folder)
    try:
        if intact.unfinished:
            meta = _without_unfinished(repo_id, folder, intact)
        else:
            meta = LeRobotDatasetMetadata(repo_id, folder)
    except Exception as error:  # several libraries read the metadata, each with errors of its own
        raise DatasetError(f"{folder}: the dataset's meta/ cannot be read ({first_line(error)})") from error
    if intact.count < intact.listed:
        logger.warning("%s", intact.lost_line(folder))
        meta.info.total_episodes, meta.info.total_frames = intact.count, intact.frames
    for key, feature in meta.features.items():
        meta.features[key] = completed(feature)
    return meta


def _without_unfinished(repo_id: str, folder: Path, intact: IntactEpisodes) -> LeRobotDatasetMetadata:
    """The metadata of a dataset some of whose tables of episodes have no footer, over which LeRobot would stumble."""
    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary)
        names = [path.relative_to(folder) for path in (folder / "meta").iterdir() if path.is_file()]
        for name in [*names, *(path.relative_to(folder) for path in intact.files)]:
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(folder / name, copy / name)
        meta = LeRobotDatasetMetadata(repo_id, copy)
    meta.root = folder
    return meta


def _from_hub(repo_id: str, folder: Path) -> Path:
    """Where LeRobot put a dataset that it downloaded."""
    try:
        return LeRobotDatasetMetadata(repo_id).root
    except Exception as error:
        raise DatasetError(
            f"no dataset {repo_id!r}: not in {folder}, and the hub does not have it or cannot be reached "
            f"({type(error).__name__}); give its folder with --root"
        ) from error


def check_version(root: Path) -> None:
    """Whether a dataset is of the version that this LeRobot reads.

    Raises:
        DatasetError: it is not; the way to convert it is named.
    """
    version = read_json(root, "meta/info.json").get("codebase_version")
    if version == "v2.1":
        todo = "add --convert to work on a converted copy of it (the source stays as it is)"
    elif str(version).startswith(("v1", "v2")):
        todo = "convert it to v2.1 with an older LeRobot first, then add --convert"
    else:
        todo = "use a LeRobot and an lerobot_msdyn that know this version"
    if version != CODEBASE_VERSION:
        raise DatasetError(f"{root} is a LeRobot dataset of version {version}; expected {CODEBASE_VERSION}; {todo}")


def read_episode(
    meta: LeRobotDatasetMetadata, index: int, cameras: list[str], config: CameraConfig, *, recorded_depth: bool = True
) -> Episode:
    """One episode with the views of `cameras`, at full size.

    Raises:
        EpisodeError: a file of the episode is absent or damaged.
        PriorError: the calibration file cannot be used.
    """
    rows = read_rows(meta, index)
    time = torch.from_numpy(rows["timestamp"].to_numpy().astype(np.float32))
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
        views[key] = View(rgb, make_camera(key, index, rgb, config), depth, depth_range)
    return Episode(
        source=EpisodeSource(meta.repo_id, meta.root, index),
        fps=meta.fps,
        time=time - time[0],
        views=views,
        state=_matrix(rows, OBS_STATE),
        action=_matrix(rows, ACTION),
        task=task_of(meta, rows),
    )


def depth_key_of(meta: LeRobotDatasetMetadata, camera: str) -> str | None:
    """The feature that holds the recorded depth of a colour camera, if there is one (`<camera>_depth`)."""
    return next((key for key in meta.depth_keys if key == f"{camera}_depth"), None)


def read_colour(meta: LeRobotDatasetMetadata, index: int, key: str, rows: pa.Table) -> UInt8[Tensor, "t h w 3"]:
    """All frames of one colour camera; chroma that was recorded at half the size is restored (`chroma`).

    Raises:
        EpisodeError: a frame is absent or cannot be decoded.
    """
    if key in meta.video_keys:
        restored = restore_chroma if is_subsampled(meta.features[key]) else Tensor.contiguous
        return _decode_video(meta, index, key, rows, lambda block: restored(block.movedim(1, -1)))
    images = [_decode_image(meta, index, key, item, cv2.IMREAD_COLOR_RGB) for item in rows[key].to_pylist()]
    return torch.from_numpy(np.stack(images))


def read_depth(
    meta: LeRobotDatasetMetadata, index: int, key: str, rows: pa.Table
) -> tuple[Float[Tensor, "t h w"], tuple[float, float]]:
    """All frames of one recorded depth camera in metres, and the range whose ends mean "not measured".

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

        depth = _decode_video(meta, index, key, rows, in_metres, is_depth=True)
        return depth, (encoder.depth_min, encoder.depth_max)
    images = [_decode_image(meta, index, key, item, cv2.IMREAD_UNCHANGED) for item in rows[key].to_pylist()]
    depth = torch.from_numpy(np.stack(images).astype(np.float32))
    return depth / depth_units_per_metre(meta, key), (0.0, float("inf"))


def _depth_encoder(meta: LeRobotDatasetMetadata, key: str) -> DepthEncoderConfig:
    try:
        return DepthEncoderConfig.from_video_info(meta.features[key].get("info") or {})
    except (ValueError, TypeError) as error:
        raise EpisodeError(
            f"{meta.repo_id}: {key} cannot be read with the settings in its info ({first_line(error)})"
        ) from error


def _decode_video(
    meta: LeRobotDatasetMetadata,
    index: int,
    key: str,
    rows: pa.Table,
    wanted: Callable[[Tensor], Tensor],
    *,
    is_depth: bool = False,
) -> Tensor:
    """What is wanted of all frames of a video, made from some [b,c,h,w] at a time, so that it is in memory once."""
    path = source_file(meta, index, meta.get_video_file_path(index, key))
    start = float(meta.episodes[index][f"videos/{key}/from_timestamp"])
    timestamps = [start + float(t) for t in rows["timestamp"].to_pylist()]
    where = f"{meta.repo_id} episode {index}, {key}"
    height, width, _ = picture_size(meta.features[key])
    frames: Tensor | None = None
    try:
        _check_stream(path, width, height)
        for first in range(0, len(timestamps), BLOCK_FRAMES):
            decoded = decode_video_frames(
                path,
                timestamps[first : first + BLOCK_FRAMES],
                TIMESTAMP_TOLERANCE_S,
                VIDEO_BACKEND,
                return_uint8=True,
                is_depth=is_depth,
            )
            block = wanted(decoded)
            if frames is None:
                frames = block.new_empty(len(timestamps), *block.shape[1:])
            frames[first : first + len(block)] = block
    except DatasetError as error:
        raise EpisodeError(f"{where}: {error}") from error
    except (*VIDEO_ERRORS, TypeError) as error:  # TypeError: settings of the depth's codes
        raise EpisodeError(
            f"{where}: {path} cannot be decoded for all of its {len(timestamps)} frames ({first_line(error)})"
        ) from error
    if frames is None:
        raise EpisodeError(f"{where}: the episode has no frames")
    return frames


def _check_stream(path: Path, width: int, height: int) -> None:
    with av.open(str(path)) as container:
        stream = container.streams.video[0].codec_context
        if (stream.width, stream.height) != (width, height):
            raise DatasetError(
                f"{path} is {stream.width}x{stream.height}; meta/info.json says {width}x{height}: correct its shape"
            )


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
