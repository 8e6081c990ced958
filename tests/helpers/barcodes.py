"""Datasets whose pictures say which row they belong to: eight bars, black or white, are a number that is the action."""

import shutil
import tempfile
from collections.abc import Sequence
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.dataset.video import tamed_av1

FRONT, SIDE = "observation.images.front", "observation.images.side"
HEIGHT, WIDTH, FPS = 48, 64, 10
BAR = WIDTH // 8
DARK, BRIGHT = 30, 220

av.logging.set_libav_level(av.logging.ERROR)


def picture(code: int) -> np.ndarray:
    """Bars of 8 px, uint8 [48,64,3]; white is 1, the highest bit left."""
    bits = [BRIGHT if code >> bit & 1 else DARK for bit in range(7, -1, -1)]
    return np.broadcast_to(np.repeat(bits, BAR).astype(np.uint8)[None, :, None], (HEIGHT, WIDTH, 3)).copy()


def code_of(shown: Any) -> int:
    """The number that a picture [48,64,3] of 0..255 shows, upright or upside down."""
    bars = np.asarray(shown, np.float64).mean((0, 2)).reshape(8, BAR)[:, 1:-1].mean(1)
    return int("".join(str(int(bar > (DARK + BRIGHT) / 2)) for bar in bars), 2)


def record(
    root: Path, lengths: Sequence[int], cameras: Sequence[str] = (FRONT,), codec: str = "h264"
) -> list[list[int]]:
    """A dataset of one video file per camera; returns the codes of its episodes."""
    shutil.copytree(_recorded(tuple(lengths), tuple(cameras), codec).name, root)
    return _episodes(lengths)


def _episodes(lengths: Sequence[int]) -> list[list[int]]:
    codes = list(range(1, 1 + sum(lengths)))
    return [[codes.pop(0) for _ in range(length)] for length in lengths]


@cache
def _recorded(lengths: tuple[int, ...], cameras: tuple[str, ...], codec: str) -> tempfile.TemporaryDirectory:
    folder = tempfile.TemporaryDirectory()
    features: dict[str, dict[str, Any]] = {
        key: {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": None} for key in cameras
    }
    features |= {"action": {"dtype": "float32", "shape": (1,), "names": None}}
    Path(folder.name).rmdir()  # LeRobot makes it
    encoder = RGBEncoderConfig(vcodec=codec)
    dataset = LeRobotDataset.create(
        "local/bars", FPS, features, root=folder.name, video_backend="pyav", rgb_encoder=encoder
    )
    for episode in _episodes(lengths):
        for code in episode:
            pictures = {key: picture(code) for key in cameras}
            dataset.add_frame(pictures | {"action": np.array([code], np.float32), "task": "show a number"})
        with tamed_av1():
            dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return folder


def write_video(
    path: Path,
    codes: Sequence[int],
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    *,
    fps: int = FPS,
    times: Sequence[float] | None = None,
    full_range: bool = False,
    options: dict[str, str] | None = None,
) -> None:
    """A video of these codes, frame i at i / fps or at times[i] (s)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, fps, options=options or {})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pix_fmt
        stream.codec_context.time_base = Fraction(1, 10_000)
        if full_range:
            stream.codec_context.color_range = 2
        for i, code in enumerate(codes):
            frame = av.VideoFrame.from_ndarray(picture(code), format="rgb24")
            if full_range:
                frame = frame.reformat(format=pix_fmt, dst_color_range="JPEG")
                frame.color_range = 2
            frame.time_base = Fraction(1, 10_000)
            frame.pts = round(10_000 * (i / fps if times is None else times[i]))
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def video_of(root: Path, key: str = FRONT) -> Path:
    """The first video file of a camera."""
    return min((root / "videos" / key).rglob("*.mp4"))


def change_table(path: Path, columns: dict[str, Sequence[Any]]) -> None:
    """Put other values into a parquet file."""
    table = pq.read_table(path)
    for name, values in columns.items():
        field = table.schema.field(name)
        table = table.set_column(table.column_names.index(name), field, [pa.array(values, field.type)])
    pq.write_table(table, path)


def episodes_table(root: Path) -> Path:
    """The file of meta/episodes."""
    return next((root / "meta" / "episodes").rglob("*.parquet"))


def place(root: Path, starts: Sequence[float], ends: Sequence[float], key: str = FRONT) -> None:
    """Where the episodes lie in the camera's file, s."""
    columns = {f"videos/{key}/from_timestamp": starts, f"videos/{key}/to_timestamp": ends}
    change_table(episodes_table(root), columns)
