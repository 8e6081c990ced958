"""Which frames of a video file show which episode.

Metadata says at what time of the file an episode begins, and LeRobot reads on from there whatever it meets. Here the
file's own frames are listed first, without decoding them, and given to its episodes: an episode gets exactly as many
frames as it has rows, none of them another's, or an error that says why not.
"""

import bisect
import logging
import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from pathlib import Path

import av
import numpy as np
from av.sidedata.sidedata import Type as SideDataType
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.dataset.rows import TIMESTAMP_TOLERANCE_S

logger = logging.getLogger(__name__)

# What a broken video can cause; AttributeError: a stream of an unknown codec has no context.
VIDEO_ERRORS = (av.FFmpegError, OSError, ValueError, RuntimeError, IndexError, AttributeError)
SURE = 0.25  # of a frame: a start that is nearer to a frame than this is that frame
COVERED = 0.75  # of a frame: less than this may follow the last frame that rows name
UPRIGHT = (1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)  # a display matrix that changes nothing
FILES_KEPT = 8  # up to 20 MB each
SPARED = 8  # frames that need not be decoded, for which a file is opened again


@dataclass(frozen=True)
class Packet:
    """One coded frame."""

    pts: int  # when it is shown, ticks
    dts: int  # when it is decoded, ticks
    is_key: bool


@dataclass(frozen=True)
class VideoIndex:
    """The frames of a video file, as its packets list them."""

    path: Path
    packets: tuple[Packet, ...]  # as they are decoded
    time_base: Fraction  # s per tick
    size: tuple[int, int]  # width and height, px
    pix_fmt: str
    complete: bool  # whether all frames are there that the file's header counts
    coding: tuple[object, ...]  # what files must have in common to be put together without encoding them again

    @cached_property
    def shown(self) -> list[int]:
        """When each frame is shown (ticks), in that order: a frame's place here is its number."""
        return sorted(packet.pts for packet in self.packets)

    @cached_property
    def times(self) -> np.ndarray:
        """The same in seconds, [n]."""
        return np.array(self.shown, np.float64) * float(self.time_base)


def index_of(path: Path) -> VideoIndex:
    """The frames of a video file.

    Raises:
        DatasetError: it is to be shown turned or mirrored, which some readers do and others do not.
        Exception: one of VIDEO_ERRORS, where it cannot be read.
    """
    about = path.stat()
    return _index(path, about.st_mtime_ns, about.st_size)


@lru_cache(FILES_KEPT)
def _index(path: Path, changed_ns: int, size: int) -> VideoIndex:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context, time_base = stream.codec_context, stream.time_base
        if context is None or time_base is None:  # copying such a stream would crash PyAV
            raise ValueError("unknown codec")
        packets = tuple(
            Packet(packet.pts, packet.pts if packet.dts is None else packet.dts, packet.is_keyframe)
            for packet in container.demux(stream)
            if packet.pts is not None and not packet.is_discard and not packet.is_corrupt
        )
        size_px, pix_fmt = (context.width, context.height), str(context.pix_fmt)
        head = bytes(context.extradata or b"")
        coding = (context.name, context.profile, pix_fmt, int(context.color_range or 0), size_px, time_base, head)
        complete = len(packets) >= stream.frames
        index = VideoIndex(path, packets, time_base, size_px, pix_fmt, complete, coding)
    _check_upright(path)
    return index


def _check_upright(path: Path) -> None:
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0), None)
        matrix = None if frame is None else frame.side_data.get(SideDataType.DISPLAYMATRIX)
        if frame is None or matrix is None or tuple(np.frombuffer(bytes(matrix), "<i4")) == UPRIGHT:
            return
        turn = f"turned by {frame.rotation} degrees" if frame.rotation else "mirrored"
    raise DatasetError(
        f"{path} is marked to be shown {turn}, which some readers do and others do not; for its pictures as they are "
        f"stored, replace it by OUT.mp4 of: ffmpeg -display_rotation:v:0 0 -i {path} -c copy OUT.mp4"
    )


@dataclass(frozen=True)
class Placed:
    """Where metadata says that an episode lies in a file."""

    episode: int
    start_s: float
    end_s: float
    rows: int


def episodes_in_file(meta: LeRobotDatasetMetadata, index: int, key: str) -> list[Placed]:
    """The episodes that lie in the same file of a camera as a given one, in the order of their starts."""
    row = meta.episodes[index]
    place = (int(row[f"videos/{key}/chunk_index"]), int(row[f"videos/{key}/file_index"]))
    return _placed(meta, key).get(place, [])


@lru_cache(FILES_KEPT)
def _placed(meta: LeRobotDatasetMetadata, key: str) -> dict[tuple[int, int], list[Placed]]:
    names = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    columns = [meta.episodes.data.column(f"videos/{key}/{name}").to_pylist() for name in names]
    lengths = meta.episodes.data.column("length").to_pylist()
    files: dict[tuple[int, int], list[Placed]] = {}
    for episode, (chunk, file, start, end, length) in enumerate(zip(*columns, lengths, strict=True)):
        if length > 0 and math.isfinite(start):
            files.setdefault((chunk, file), []).append(Placed(episode, float(start), float(end), int(length)))
    return {place: sorted(found, key=lambda one: (one.start_s, one.episode)) for place, found in files.items()}


def frame_numbers(
    video: VideoIndex,
    placed: Sequence[Placed],
    episode: int,
    row_times: np.ndarray,
    fps: int | float,
    tolerance_s: float = TIMESTAMP_TOLERANCE_S,
) -> list[int]:
    """Which frames of a file belong to the rows of one episode.

    Where a file has exactly as many frames as its episodes have rows, they are dealt out in order, unless metadata
    places an episode exactly on another frame. Else an episode has the frames from its start up to its end or the next
    start; if these are as many as its rows, they are its rows', and
    if they are more, they must be at the rows' times (a video of twice the rate).

    Args:
        video: the file.
        placed: the episodes in it, in the order of their starts.
        episode: which of them.
        row_times: the recorded times [t] of its rows, s since the episode's start.
        fps: rows per second.
        tolerance_s: how far a frame may be from its row's time where they are told by times, s.

    Raises:
        DatasetError: the file does not hold these frames, or nothing says which they are.
    """
    times, position = video.times, [one.episode for one in placed].index(episode)
    me, rows, total = placed[position], len(row_times), sum(one.rows for one in placed)
    firsts = np.cumsum([0, *(one.rows for one in placed[:-1])])
    if total == len(times):
        counted = list(range(firsts[position], firsts[position] + rows))
        if not _contradicted(times, placed, firsts, fps):
            return counted
        if any(np.abs(times - one.start_s).min() > SURE / fps for one in placed):  # no start can be relied on
            if abs(times[firsts[position]] - me.start_s) <= SURE / fps:
                return counted
            raise DatasetError(
                f"it starts at {me.start_s:.4f} s of {video.path}, by counting frames at {times[counted[0]]:.4f} s, "
                "and others start between two frames: nothing says which are its own; correct from_timestamp in "
                "meta/episodes"
            )
    half = 0.5 / fps
    twin = next((one.episode for one in placed if one is not me and abs(one.start_s - me.start_s) < half), None)
    if twin is not None:
        raise DatasetError(f"it starts where episode {twin} starts in {video.path}; correct meta/episodes")
    beyond = max(one.end_s for one in placed if math.isfinite(one.end_s)) - (times[-1] + 1 / fps) if len(times) else 0.0
    if total > len(times) and video.complete and len(placed) > 1 and beyond >= half:
        raise DatasetError(
            f"{video.path} has {len(times)} video frames for {total} rows of its {len(placed)} episodes, and nothing "
            "says which of them lost frames; record them again, or leave them out with --episodes"
        )
    first = int(np.searchsorted(times, me.start_s - half))
    after = min((one.start_s for one in placed if one.start_s > me.start_s), default=math.inf)
    bound = int(np.searchsorted(times, after - half))
    end = min(bound, int(np.searchsorted(times, me.end_s - half))) if me.end_s > me.start_s else bound
    if first < len(times) and abs(times[first] - me.start_s) > SURE / fps:
        raise DatasetError(
            f"it starts at {me.start_s:.4f} s of {video.path}, between two frames, and the file has {len(times)} video "
            f"frames for {total} rows: nothing says which are its own; correct from_timestamp in meta/episodes"
        )
    if rows in (bound - first, end - first):
        if total < len(times):
            _say_left_over(video.path, len(times) - total)
        return list(range(first, first + rows))
    return _by_times(video, times[first:end], first, me.start_s + row_times, fps, tolerance_s)


def _contradicted(times: np.ndarray, placed: Sequence[Placed], firsts: np.ndarray, fps: int | float) -> bool:
    """Whether metadata places an episode exactly on another frame than the one that is its by counting."""
    for one, first in zip(placed, firsts, strict=True):
        away = abs(times[first] - one.start_s)
        if away >= 0.5 / fps and np.abs(times - one.start_s).min() <= TIMESTAMP_TOLERANCE_S:
            return True
    return False


def _by_times(
    video: VideoIndex, times: np.ndarray, first: int, wanted: np.ndarray, fps: int | float, tolerance_s: float
) -> list[int]:
    problem = f"{len(times)} video frames for {len(wanted)} rows in {video.path}"
    if len(times) <= len(wanted):
        raise DatasetError(f"{problem}: frames were dropped, and nothing says which")
    nearest = np.abs(times[None] - wanted[:, None]).argmin(1)
    off_s = float(np.abs(times[nearest] - wanted).max())
    if (np.diff(nearest) < 1).any() or times[-1] - times[nearest[-1]] >= COVERED / fps or off_s >= 0.5 / fps:
        raise DatasetError(f"{problem}: nothing says which frames are the rows'")
    if off_s >= tolerance_s:
        raise DatasetError(f"{problem}, up to {off_s:.4f} s from the rows' times; --tolerance_s allows it")
    return [first + int(number) for number in nearest]


@lru_cache(FILES_KEPT)
def _say_left_over(path: Path, count: int) -> None:
    logger.warning("%s has %d video frames more than its episodes have rows", path, count)


def decoded(video: VideoIndex, numbers: Sequence[int], *, is_depth: bool = False) -> Iterator[np.ndarray]:
    """The pictures of some frames, by ascending numbers, as LeRobot decodes them.

    Colours are uint8 [h,w,3], depth codes uint16 [h,w].

    Raises:
        ValueError: a frame cannot be decoded.
        Exception: one of VIDEO_ERRORS.
    """
    for stretch in _stretches(video, numbers):
        yield from _decoded(video, stretch, is_depth=is_depth)


def _stretches(video: VideoIndex, numbers: Sequence[int]) -> list[list[int]]:
    """The numbers, cut where a key frame spares the decoding of many frames between two of them."""
    place = {pts: number for number, pts in enumerate(video.shown)}
    keys = sorted(place[packet.pts] for packet in video.packets if packet.is_key)
    stretches: list[list[int]] = [[]]
    for number in numbers:
        key = keys[bisect.bisect(keys, number) - 1] if keys and keys[0] <= number else 0
        if stretches[-1] and key - stretches[-1][-1] > SPARED:
            stretches.append([])
        stretches[-1].append(number)
    return stretches


def _decoded(video: VideoIndex, numbers: Sequence[int], *, is_depth: bool) -> Iterator[np.ndarray]:
    """The same of frames between which all are decoded."""
    shown = video.shown
    wanted = deque(shown[number] for number in numbers)
    starts = [packet.dts for packet in video.packets if packet.is_key and packet.pts <= wanted[0]]
    for start in (max(starts, default=None), None):
        with av.open(str(video.path)) as container:
            stream = container.streams.video[0]
            if start is not None:
                container.seek(start, stream=stream, backward=True, any_frame=False)
            for frame in container.decode(stream):
                if frame.pts is None or frame.pts < wanted[0]:
                    continue
                if frame.pts > wanted[0]:  # the file's index led past it
                    break
                picture = frame.to_ndarray(format="gray12le" if is_depth else "rgb24")
                while wanted and wanted[0] == frame.pts:
                    wanted.popleft()
                    yield picture
                if not wanted:
                    return
    raise ValueError(f"frame {len(shown) - len(wanted)} cannot be decoded")
