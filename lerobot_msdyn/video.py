"""Video files: encode frames as the source was encoded, and cut an episode out of a shared file without loss."""

import os
import shutil
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8, UInt16
from lerobot.configs import DepthEncoderConfig, RGBEncoderConfig, VideoEncoderConfig
from lerobot.datasets.pyav_utils import write_u16_plane
from lerobot.datasets.video_utils import decode_video_frames, get_video_duration_in_s

from lerobot_msdyn.episode import TIMESTAMP_TOLERANCE_S, VIDEO_BACKEND
from lerobot_msdyn.errors import EpisodeError, OutputError


def quiet_encoders() -> None:
    """FFmpeg and the AV1 encoder write to stderr past every logger: let them write errors only."""
    av.logging.set_libav_level(av.logging.ERROR)
    os.environ.setdefault("SVT_LOG", "1")


def encoder_of(feature: dict, key: str) -> RGBEncoderConfig | DepthEncoderConfig:
    """LeRobot's encoder settings that a video feature was recorded with (codec, pixel format, quality).

    Raises:
        OutputError: this machine's FFmpeg cannot encode with them.
    """
    info = feature.get("info") or {}
    kind = DepthEncoderConfig if info.get("is_depth_map") or info.get("video.is_depth_map") else RGBEncoderConfig
    try:
        return kind.from_video_info(info)
    except ValueError as error:
        raise OutputError(f"{key}: cannot encode video as its source ({error})") from error


def encode_video(
    frames: Iterable[UInt8[np.ndarray, "h w 3"]], path: Path, fps: int, encoder: VideoEncoderConfig
) -> int:
    """Encode frames as they come; returns their number."""
    return _encode((av.VideoFrame.from_ndarray(frame, format="rgb24") for frame in frames), path, fps, encoder)


def _encode(frames: Iterable[av.VideoFrame], path: Path, fps: int, encoder: VideoEncoderConfig) -> int:
    quiet_encoders()
    path.parent.mkdir(parents=True, exist_ok=True)
    count = 0
    with av.open(str(path), "w") as container:
        stream = None
        for frame in frames:
            if stream is None:
                stream = container.add_stream(encoder.vcodec, fps, options=encoder.get_codec_options(as_strings=True))
                stream.pix_fmt = encoder.pix_fmt
                stream.width, stream.height = frame.width, frame.height
            frame.pts = count
            frame.time_base = Fraction(1, fps)
            container.mux(stream.encode(frame))
            count += 1
        if stream is not None:
            container.mux(stream.encode())
    return count


def cut_video(
    source: Path, start_s: float, frames: int, fps: int, encoder: RGBEncoderConfig | DepthEncoderConfig, path: Path
) -> None:
    """Copy one episode out of a video file: packet by packet where it starts with a key frame, else encoded anew.

    Raises:
        EpisodeError: the file does not hold these frames.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        if start_s == 0 and abs(get_video_duration_in_s(source) * fps - frames) < 0.5:
            shutil.copyfile(source, path)
        else:
            _copy_packets(source, start_s, frames, fps, path)
        if frame_times(path) != [Fraction(i, fps) for i in range(frames)]:
            _encode_anew(source, start_s, frames, fps, encoder, path)
    except (OSError, ValueError, RuntimeError) as error:
        raise EpisodeError(f"{source}: no {frames} frames from {start_s:.3f} s on ({type(error).__name__})") from error


def frame_times(path: Path) -> list[Fraction]:
    """Presentation times (s) of all frames of a video, in order, rounded to the nearest 1/1000 of a frame."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        rate = stream.average_rate or stream.base_rate
        times = [packet.pts * stream.time_base for packet in container.demux(stream) if packet.pts is not None]
    return sorted(Fraction(round(time * rate * 1000), 1000) / rate for time in times)


def _copy_packets(source: Path, start_s: float, frames: int, fps: int, path: Path) -> None:
    half = 0.5 / fps
    with av.open(str(source)) as reader, av.open(str(path), "w", options={"movflags": "faststart"}) as writer:
        stream = reader.streams.video[0]
        copy = writer.add_stream_from_template(template=stream, opaque=True)
        copy.time_base = stream.time_base
        reader.seek(round(start_s / stream.time_base), stream=stream, backward=True, any_frame=False)
        first = None
        for packet in reader.demux(stream):
            if packet.dts is None or packet.pts is None:
                continue
            time = float(packet.pts * stream.time_base) - start_s
            if time < -half or time > frames / fps - half:
                continue
            first = packet.pts if first is None else first
            packet.pts -= first
            packet.dts -= first
            packet.stream = copy
            writer.mux(packet)


def _encode_anew(
    source: Path, start_s: float, frames: int, fps: int, encoder: RGBEncoderConfig | DepthEncoderConfig, path: Path
) -> None:
    is_depth = isinstance(encoder, DepthEncoderConfig)
    times = [start_s + i / fps for i in range(frames)]
    pictures = decode_video_frames(
        source, times, TIMESTAMP_TOLERANCE_S, VIDEO_BACKEND, return_uint8=True, is_depth=is_depth
    )
    if isinstance(encoder, DepthEncoderConfig):
        codes = pictures[:, 0].numpy().astype(np.uint16)
        _encode((_depth_frame(code, encoder) for code in codes), path, fps, encoder)
    else:
        encode_video((picture.permute(1, 2, 0).numpy() for picture in pictures), path, fps, encoder)


def _depth_frame(codes: UInt16[np.ndarray, "h w"], encoder: DepthEncoderConfig) -> av.VideoFrame:
    """A video frame of depth codes that are quantised already."""
    frame = av.VideoFrame.from_ndarray(codes, format=encoder.pix_fmt)
    write_u16_plane(frame.planes[0], codes)
    return frame
