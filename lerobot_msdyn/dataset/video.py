"""Video files: encode frames as the source was encoded, and cut an episode out of a shared file without loss."""

import contextlib
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import numpy as np
from lerobot.configs import DepthEncoderConfig, RGBEncoderConfig
from lerobot.datasets.depth_utils import quantize_depth
from lerobot.datasets.pyav_utils import write_u16_plane

from lerobot_msdyn.core.errors import EpisodeError, OutputError, first_line
from lerobot_msdyn.core.files import DISK_FAULTS
from lerobot_msdyn.dataset.rows import TIMESTAMP_TOLERANCE_S
from lerobot_msdyn.dataset.video_index import VIDEO_ERRORS, Packet, VideoIndex, decoded

logger = logging.getLogger(__name__)

NVENC = {"h264": "h264_nvenc", "hevc": "hevc_nvenc"}  # LeRobot's encoders: on the processor, and on an NVIDIA GPU
SVT_LOG, SVT_ERRORS = "SVT_LOG", "1"  # how much the AV1 encoder writes to stderr; read when it is opened
X265, X265_PARAMS, X265_LOG = {"hevc", "libx265"}, "x265-params", "log-level"
MAX_LEVEL_ERROR = 16  # of 255; coding changes a frame's mean brightness by less than 2, an empty frame by more


def quiet_encoders() -> None:
    """FFmpeg and the AV1 encoder write to stderr past every logger; what goes wrong is raised as well.

    For the rest of the process, so for commands only.
    """
    av.logging.set_libav_level(av.logging.FATAL)
    os.environ.setdefault(SVT_LOG, SVT_ERRORS)


@contextlib.contextmanager
def tamed_av1() -> Iterator[None]:
    """An AV1 encoder that is opened here logs nothing but errors, unless the user has set SVT_LOG.

    It runs at `ordinary_priority` besides.
    """
    quiet = SVT_LOG not in os.environ
    os.environ.setdefault(SVT_LOG, SVT_ERRORS)
    try:
        with ordinary_priority():
            yield
    finally:
        if quiet:
            os.environ.pop(SVT_LOG, None)


@contextlib.contextmanager
def ordinary_priority() -> Iterator[None]:
    """No thread of this process is left in real time by what is done here.

    Where root runs it, SVT-AV1 makes its own threads and the one that opens it real-time threads of the highest
    priority, for good: they starve the rest of the machine, and where they wait for each other, themselves. Processes
    that are started later inherit it.
    """
    before = _real_time_threads()
    try:
        yield
    finally:
        for thread in _real_time_threads() - before:
            with contextlib.suppress(OSError):  # it has ended
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))


def _real_time_threads() -> set[int]:
    """Those of this process that the system runs before all ordinary ones, where it tells."""
    if not hasattr(os, "sched_getscheduler"):
        return set()
    threads = set()
    for thread in map(int, os.listdir("/proc/self/task")):
        with contextlib.suppress(OSError):  # it has ended
            if os.sched_getscheduler(thread) == os.SCHED_FIFO:
                threads.add(thread)
    return threads


def frame_rate(fps: int | float) -> Fraction:
    """A rate as video files hold it, e.g. 30000/1001."""
    return Fraction(fps).limit_denominator(1001)


def encoder_of(feature: dict, key: str) -> RGBEncoderConfig | DepthEncoderConfig:
    """LeRobot's encoder settings that a video feature was recorded with (codec, pixel format, quality).

    Raises:
        OutputError: this machine's FFmpeg cannot encode with them.
    """
    info = feature.get("info") or {}
    kind = DepthEncoderConfig if info.get("is_depth_map") or info.get("video.is_depth_map") else RGBEncoderConfig
    try:
        return kind.from_video_info(info)
    except (ValueError, TypeError) as error:
        raise OutputError(f"{key}: cannot encode video like its source ({error})") from error


def nvenc_of(encoder: RGBEncoderConfig | DepthEncoderConfig) -> RGBEncoderConfig | DepthEncoderConfig:
    """The settings for NVENC, where LeRobot has them for the codec and the GPU can encode; else the given ones.

    The codec stays what it was; LeRobot passes the quality on as NVENC's constant quantiser. Depth is never given to
    it: NVENC has no format of one channel and 12 bits.
    """
    name = NVENC.get(encoder.vcodec)
    if name is None or isinstance(encoder, DepthEncoderConfig) or not _can_encode(name):
        return encoder
    return replace(encoder, vcodec=name, preset=None)


@cache
def _can_encode(name: str) -> bool:
    """Whether an encoder can be opened: FFmpeg lists those of GPUs on every machine."""
    try:
        codec = av.CodecContext.create(name, "w")
        codec.width, codec.height, codec.pix_fmt, codec.time_base = 256, 256, "yuv420p", Fraction(1, 30)
        codec.open()
    except (av.FFmpegError, ValueError) as error:
        logger.warning("%s cannot be used here (%s): videos are encoded on the processor", name, error)
        return False
    return True


class VideoFile:
    """An mp4 file that grows frame by frame, encoded as the source was."""

    def __init__(self, path: Path, fps: int | float, encoder: RGBEncoderConfig | DepthEncoderConfig) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._rate, self._encoder = frame_rate(fps), encoder
        self._container = av.open(str(path), "w")
        self._stream: av.VideoStream | None = None
        self._count = 0

    def __enter__(self) -> "VideoFile":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(self, picture: np.ndarray) -> None:
        """Append colours uint8 [h,w,3], depth float32 [h,w] in m, or depth codes uint16 [h,w] that are quantised."""
        if picture.ndim == 3:
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        else:
            frame = _depth_frame(picture, self._encoder)
        if self._stream is None:
            options = _quiet(self._encoder.vcodec, self._encoder.get_codec_options(as_strings=True))
            self._stream = self._container.add_stream(self._encoder.vcodec, self._rate, options=options)
            self._stream.pix_fmt = self._encoder.pix_fmt
            self._stream.width, self._stream.height = frame.width, frame.height
        frame.pts = self._count
        frame.time_base = 1 / self._rate
        with contextlib.nullcontext() if self._count else tamed_av1():  # the first frame opens the encoder
            packets = self._stream.encode(frame)
        self._container.mux(packets)
        self._count += 1

    def close(self) -> None:
        """Write what the encoder still holds, and the file's index."""
        if self._stream is not None:
            self._container.mux(self._stream.encode())
        self._container.close()


def _quiet(codec: str, options: dict[str, str]) -> dict[str, str]:
    """Options of an encoder that logs nothing but errors: x265 asks nobody but its own parameters."""
    params = options.get(X265_PARAMS, "")
    if codec not in X265 or X265_LOG in params:
        return options
    return options | {X265_PARAMS: ":".join(filter(None, (params, f"{X265_LOG}=error")))}


def _depth_frame(depth: np.ndarray, encoder: RGBEncoderConfig | DepthEncoderConfig) -> av.VideoFrame:
    codes = depth
    if depth.dtype != np.uint16:
        codes = quantize_depth(
            depth,
            depth_min=encoder.depth_min,
            depth_max=encoder.depth_max,
            shift=encoder.shift,
            use_log=encoder.use_log,
            video_backend=None,
            input_unit="m",
        )
    frame = av.VideoFrame.from_ndarray(codes, format=encoder.pix_fmt)
    write_u16_plane(frame.planes[0], codes)
    return frame


def cut_video(
    video: VideoIndex,
    numbers: Sequence[int],
    fps: int | float,
    encoder: Callable[[], RGBEncoderConfig | DepthEncoderConfig],
    path: Path,
) -> None:
    """Copy one episode out of a video file: packet by packet where these can be decoded alone, else encoded anew.

    Args:
        video: the file.
        numbers: which of its frames, ascending.
        fps: frames per second of the copy, which starts at 0 s.
        encoder: gives the settings, should they be needed.
        path: where the copy goes.

    Raises:
        EpisodeError: the file does not hold these frames, or they must be encoded anew and cannot be.
        OSError: the disk to write to is full.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        packets = _alone(video, numbers)
        if len(packets) == len(video.packets) > 0:
            shutil.copyfile(video.path, path)
        elif packets:
            _copy_packets(video, packets, fps, path)
        if not packets or frame_times(path) != [i / frame_rate(fps) for i in range(len(numbers))]:
            _encode_anew(video, numbers, fps, encoder(), path)
    except OutputError as error:
        raise EpisodeError(f"{video.path}: frames cannot be copied without encoding them anew, and {error}") from error
    except VIDEO_ERRORS as error:
        if isinstance(error, OSError) and error.errno in DISK_FAULTS:
            raise
        raise EpisodeError(f"{video.path}: its frames cannot be copied ({first_line(error)})") from error


def _alone(video: VideoIndex, numbers: Sequence[int]) -> tuple[Packet, ...]:
    """The packets of some frames, if they can be decoded without any other; else none.

    They can, where the first that is decoded is a key frame, the first that is shown, and no other lies among them.
    """
    shown = video.shown
    wanted = {shown[number] for number in numbers}
    at = [i for i, packet in enumerate(video.packets) if packet.pts in wanted]
    packets = video.packets[at[0] : at[-1] + 1] if at else ()
    alone = len(packets) == len(numbers) == len(wanted) and packets[0].is_key and packets[0].pts == min(wanted)
    return packets if alone else ()


def frame_times(path: Path) -> list[Fraction]:
    """When a video shows its frames (s), in order, rounded to the nearest 1/1000 of a frame."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        rate = stream.average_rate or stream.base_rate
        times = [
            packet.pts * stream.time_base
            for packet in container.demux(stream)
            if packet.pts is not None and not packet.is_discard
        ]
    return sorted(Fraction(round(time * rate * 1000), 1000) / rate for time in times)


def problem_of(
    path: Path, frames: int, fps: int | float, size: tuple[int, int], levels: Sequence[float] | None = None
) -> str | None:
    """What is wrong with a video, found by decoding it all; None if nothing is.

    Args:
        path: the file.
        frames: how many it should have, the i-th at i / fps seconds within LeRobot's tolerance.
        fps: frames per second.
        size: width and height, px.
        levels: the mean brightness (0 to 255) that each frame was given.
    """
    count = 0
    try:
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                if frame.pts is None or abs(float(frame.pts * frame.time_base) - count / fps) > TIMESTAMP_TOLERANCE_S:
                    return f"frame {count} is not at {count / fps:.4f} s"
                if (frame.width, frame.height) != size:
                    return f"frame {count} is {frame.width}x{frame.height}; expected {size[0]}x{size[1]}"
                if frame.is_corrupt:
                    return f"frame {count} is damaged"
                if levels is not None and count < frames:
                    level = float(frame.to_ndarray(format="rgb24").mean())
                    if abs(level - levels[count]) > MAX_LEVEL_ERROR:
                        return f"frame {count} has brightness {level:.0f}; {levels[count]:.0f} was given"
                count += 1
    except VIDEO_ERRORS as error:
        return f"it cannot be decoded after {count} frames ({type(error).__name__})"
    return None if count == frames else f"it has {count} frames; expected {frames}"


def _copy_packets(video: VideoIndex, packets: Sequence[Packet], fps: int | float, path: Path) -> None:
    first, wanted = packets[0], {packet.pts for packet in packets}
    frame_ticks = round(1 / frame_rate(fps) / video.time_base)
    with av.open(str(video.path)) as reader, av.open(str(path), "w", options={"movflags": "faststart"}) as writer:
        stream = reader.streams.video[0]
        copy = writer.add_stream_from_template(template=stream, opaque=True)
        copy.time_base = stream.time_base
        reader.seek(first.dts, stream=stream, backward=True, any_frame=False)
        for packet in reader.demux(stream):
            if packet.dts is None or packet.pts not in wanted:
                continue
            wanted.remove(packet.pts)
            packet.pts -= first.pts
            packet.dts -= first.pts
            packet.duration = packet.duration or frame_ticks  # the last frame of a file is not shown without one
            packet.stream = copy
            writer.mux(packet)
            if not wanted:
                break


def _encode_anew(
    video: VideoIndex,
    numbers: Sequence[int],
    fps: int | float,
    encoder: RGBEncoderConfig | DepthEncoderConfig,
    path: Path,
) -> None:
    with VideoFile(path, fps, encoder) as file:
        for picture in decoded(video, numbers, is_depth=isinstance(encoder, DepthEncoderConfig)):
            file.add(picture)
