"""Read LeRobot episodes into plain tensors: pixels, cameras, recorded depth, state and action."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Float, UInt8
from lerobot.configs import DepthEncoderConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.depth_utils import dequantize_depth
from lerobot.datasets.utils import CompatibilityError
from lerobot.datasets.video_utils import decode_video_frames
from lerobot.utils.constants import ACTION, HF_LEROBOT_HOME, OBS_STATE
from torch import Tensor

from lerobot_msdyn.cameras import CameraTrack, intrinsics_from_fov, read_calibration, static_camera
from lerobot_msdyn.config import CameraConfig
from lerobot_msdyn.errors import DatasetError, EpisodeError

VIDEO_BACKEND = "pyav"
TIMESTAMP_TOLERANCE_S = 1e-4
CODEBASE_VERSION = "v3.0"
MILLIMETRES = 1000.0
ON_ROBOT = ("wrist", "hand", "gripper", "palm", "finger", "effector", "flange", "tool")  # in names of cameras


@dataclass(frozen=True)
class View:
    """What one camera recorded."""

    rgb: UInt8[Tensor, "t h w 3"]
    camera: CameraTrack
    depth: Float[Tensor, "t h w"] | None = None  # m, z-depth; as recorded, see `depth_range`
    depth_range: tuple[float, float] = (0.0, float("inf"))  # m; values at the ends mean "not measured"


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
    fps: int
    time: Float[Tensor, " t"]  # s since the episode's start
    views: dict[str, View]
    state: Float[Tensor, "t s"] | None
    action: Float[Tensor, "t a"] | None
    task: str

    def __len__(self) -> int:
        return self.time.shape[0]


def open_source(repo_id: str, root: Path | None = None) -> LeRobotDatasetMetadata:
    """The metadata of a dataset in `root`, else in LeRobot's home, else on the hub. Nothing is written to `root`.

    Raises:
        DatasetError: there is no such dataset, or it is not of version v3.0.
    """
    folder = HF_LEROBOT_HOME / repo_id if root is None else root
    info_path = folder / "meta" / "info.json"
    if root is not None and not info_path.is_file():
        raise DatasetError(
            f"no dataset in {root}: {info_path} is absent; "
            "--root is the exact folder that holds meta/, data/ and videos/"
        )
    if info_path.is_file():
        _check_version(info_path)
    try:
        return LeRobotDatasetMetadata(repo_id, root)
    except (OSError, ValueError, KeyError, TypeError, CompatibilityError, httpx.HTTPError) as error:
        if info_path.is_file():
            raise DatasetError(
                f"{folder}: the dataset's meta/ cannot be read ({type(error).__name__}: {error})"
            ) from error
        raise DatasetError(
            f"no dataset {repo_id!r}: not in {folder}, and the hub does not have it or cannot be reached "
            f"({type(error).__name__}); give its folder with --root"
        ) from error


def _check_version(info_path: Path) -> None:
    try:
        version = json.loads(info_path.read_text()).get("codebase_version")
    except (OSError, ValueError, AttributeError) as error:
        raise DatasetError(f"{info_path} is not readable JSON ({error})") from error
    if version == "v2.1":
        todo = (
            "convert a copy of it with "
            "`python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=NAME --root=FOLDER --push-to-hub=false`"
        )
    elif str(version).startswith(("v1", "v2")):
        todo = "convert it to v2.1 with an older LeRobot first, then with lerobot.scripts.convert_dataset_v21_to_v30"
    else:
        todo = "use a LeRobot and an lerobot_msdyn that know this version"
    if version != CODEBASE_VERSION:
        raise DatasetError(
            f"{info_path.parent.parent} is a LeRobot dataset of version {version}; expected {CODEBASE_VERSION}; {todo}"
        )


def select_episodes(meta: LeRobotDatasetMetadata, episodes: list[int] | None) -> list[int]:
    """The episodes asked for, each once and in order; all of them if none are named.

    Raises:
        DatasetError: an index is out of range.
    """
    if episodes is None:
        return list(range(meta.total_episodes))
    bad = [index for index in episodes if not 0 <= index < meta.total_episodes]
    if bad:
        raise DatasetError(
            f"{meta.repo_id}: no episode {', '.join(map(str, bad))}; "
            f"it has {meta.total_episodes} (0 to {meta.total_episodes - 1})"
        )
    return sorted(set(episodes))


def colour_cameras(meta: LeRobotDatasetMetadata) -> list[str]:
    """Feature keys of the colour cameras."""
    return [key for key in meta.camera_keys if key not in meta.depth_keys]


def select_cameras(meta: LeRobotDatasetMetadata, cameras: list[str] | None, *, allow_moving: bool = False) -> list[str]:
    """The cameras to re-render: those asked for (by key or its last part), else all that are not on the robot.

    Raises:
        DatasetError: a name is unknown or of a camera on the robot, or no camera is left.
    """
    known = colour_cameras(meta)
    if cameras is None:
        chosen = [key for key in known if allow_moving or not is_wrist_camera(key)]
        if not chosen:
            raise DatasetError(
                f"{meta.repo_id}: no camera to re-render; its colour cameras are {', '.join(known) or 'none'}"
            )
        return chosen
    chosen = []
    for name in cameras:
        matches = [key for key in known if name in (key, key.rsplit(".", 1)[-1])]
        if not matches:
            raise DatasetError(f"{meta.repo_id}: no colour camera {name!r}; it has {', '.join(known) or 'none'}")
        chosen += [key for key in matches if key not in chosen]
    on_robot = [key for key in chosen if is_wrist_camera(key)]
    if on_robot and not allow_moving:
        raise DatasetError(
            f"{meta.repo_id}: {', '.join(on_robot)} moves with the robot, by its name: its picture is tied to the "
            "state, and would belong to another one; leave it out, or allow it by --allow_moving"
        )
    return chosen


def is_wrist_camera(key: str) -> bool:
    """Whether a camera's name says that it moves with the robot."""
    name = key.rsplit(".", 1)[-1].lower()
    return any(word in name for word in ON_ROBOT)


def read_rows(meta: LeRobotDatasetMetadata, index: int) -> pa.Table:
    """The parquet rows of one episode, in order and bit for bit.

    Raises:
        EpisodeError: the data file is absent, damaged, or has another number of rows than the metadata says.
    """
    path = inside_root(meta, meta.get_data_file_path(index))
    try:
        rows = pq.read_table(path, filters=[("episode_index", "=", index)])
    except (OSError, pa.ArrowException) as error:
        raise EpisodeError(f"{meta.repo_id} episode {index}: {path} cannot be read ({_first_line(error)})") from error
    expected = int(meta.episodes[index]["length"])
    if rows.num_rows != expected or expected == 0:
        raise EpisodeError(f"{meta.repo_id} episode {index}: {path} has {rows.num_rows} rows; expected {expected}")
    return rows.sort_by("frame_index")


def inside_root(meta: LeRobotDatasetMetadata, relative: Path) -> Path:
    """The file of a dataset at a path that its metadata gives; such a path may not leave the dataset's folder.

    Raises:
        DatasetError: it does.
    """
    path = (meta.root / relative).resolve()
    if not path.is_relative_to(meta.root.resolve()):
        raise DatasetError(
            f"{meta.repo_id}: its metadata names {relative}, which is outside of {meta.root}; refusing to read it"
        )
    return path


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
    task = str(meta.tasks.iloc[int(rows["task_index"][0].as_py())].name)
    return Episode(
        source=EpisodeSource(meta.repo_id, meta.root, index),
        fps=meta.fps,
        time=time - time[0],
        views=views,
        state=_matrix(rows, OBS_STATE),
        action=_matrix(rows, ACTION),
        task=task,
    )


def make_camera(key: str, index: int, rgb: UInt8[Tensor, "t h w 3"], config: CameraConfig) -> CameraTrack:
    """The calibrated camera, or a fixed one with the configured field of view."""
    frames, height, width = rgb.shape[:3]
    if config.calibration is not None:
        camera = read_calibration(config.calibration, key, index, frames, width, height)
        if camera is not None:
            return camera
    return static_camera(intrinsics_from_fov(width, height, config.horizontal_fov_deg), frames, width, height)


def shrink(view: View, max_width: int) -> View:
    """The same video with at most `max_width` columns; depth keeps its values (nearest pixel)."""
    height, width = view.rgb.shape[1:3]
    if width <= max_width:
        return view
    size = (max_width, round(height * max_width / width))
    rgb = np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in view.rgb.numpy()])
    depth: Float[Tensor, "t h w"] | None = None
    if view.depth is not None:
        images = [cv2.resize(image, size, interpolation=cv2.INTER_NEAREST) for image in view.depth.numpy()]
        depth = torch.from_numpy(np.stack(images))
    return View(torch.from_numpy(rgb), view.camera.resized(*size), depth, view.depth_range)


def depth_key_of(meta: LeRobotDatasetMetadata, camera: str) -> str | None:
    """The feature that holds the recorded depth of a colour camera, if there is one (`<camera>_depth`)."""
    return next((key for key in meta.depth_keys if key == f"{camera}_depth"), None)


def read_colour(meta: LeRobotDatasetMetadata, index: int, key: str, rows: pa.Table) -> UInt8[Tensor, "t h w 3"]:
    """All frames of one colour camera.

    Raises:
        EpisodeError: a frame is absent or cannot be decoded.
    """
    if key in meta.video_keys:
        frames = _decode_video(meta, index, key, rows, is_depth=False)
        return frames.permute(0, 2, 3, 1).contiguous()
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
        encoder = DepthEncoderConfig.from_video_info(meta.features[key].get("info") or {})
        depth = dequantize_depth(
            _decode_video(meta, index, key, rows, is_depth=True),
            depth_min=encoder.depth_min,
            depth_max=encoder.depth_max,
            shift=encoder.shift,
            use_log=encoder.use_log,
            output_unit="m",
        )
        return depth[:, 0].float(), (encoder.depth_min, encoder.depth_max)
    images = [_decode_image(meta, index, key, item, cv2.IMREAD_UNCHANGED) for item in rows[key].to_pylist()]
    depth = torch.from_numpy(np.stack(images).astype(np.float32))
    return depth / depth_units_per_metre(meta, key), (0.0, float("inf"))


def _decode_video(meta: LeRobotDatasetMetadata, index: int, key: str, rows: pa.Table, *, is_depth: bool) -> Tensor:
    path = inside_root(meta, meta.get_video_file_path(index, key))
    start = float(meta.episodes[index][f"videos/{key}/from_timestamp"])
    timestamps = [start + float(t) for t in rows["timestamp"].to_pylist()]
    where = f"{meta.repo_id} episode {index}, {key}"
    if not path.is_file():
        raise EpisodeError(f"{where}: {path} is absent")
    try:
        return decode_video_frames(
            path, timestamps, TIMESTAMP_TOLERANCE_S, VIDEO_BACKEND, return_uint8=True, is_depth=is_depth
        )
    except (OSError, ValueError, RuntimeError, IndexError) as error:  # PyAV's errors are OSErrors and ValueErrors
        raise EpisodeError(
            f"{where}: {path} cannot be decoded for all of its {len(timestamps)} frames ({_first_line(error)})"
        ) from error


def _decode_image(meta: LeRobotDatasetMetadata, index: int, key: str, item: dict[str, Any], flags: int) -> np.ndarray:
    """One image of an image feature: the bytes in the parquet row, else the file that it names inside the dataset."""
    content = item["bytes"]
    if content is None:
        content = inside_root(meta, Path(item["path"])).read_bytes()
    image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    if image is None:
        raise EpisodeError(f"{meta.repo_id} episode {index}, {key}: an image of {len(content)} bytes cannot be decoded")
    return image


def encode_image(image: np.ndarray, suffix: str) -> bytes:
    """An image file's content: colours uint8 [h,w,3], or depth [h,w] as it is stored."""
    ok, content = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image)
    if not ok:
        raise EpisodeError(f"an image of shape {image.shape} cannot be encoded as {suffix}")
    return bytes(content.tobytes())


def depth_units_per_metre(meta: LeRobotDatasetMetadata, key: str) -> float:
    """How many of the units in which a depth feature was recorded make a metre (LeRobot's default: millimetres)."""
    return 1.0 if (meta.features[key].get("info") or {}).get("depth_unit") == "m" else MILLIMETRES


def _matrix(rows: pa.Table, key: str) -> Float[Tensor, "t n"] | None:
    if key not in rows.column_names:
        return None
    values = np.stack([np.atleast_1d(np.asarray(item, np.float32)) for item in rows[key].to_pylist()])
    return torch.from_numpy(values)


def _first_line(error: BaseException) -> str:
    text = str(error).strip()
    return f"{type(error).__name__}: {text.splitlines()[0]}" if text else type(error).__name__
