"""Datasets with the faults that recorders, merges and phones make, for `fuzz.py`.

Each kind is a function of a recorded dataset (`record`), which it changes in place, and a random generator. It returns
what it did and what its pictures show: by camera and episode, the marks that each row may show; `ANY` where no picture
of that row is left to compare.
"""

import json
import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.configs import DepthEncoderConfig, RGBEncoderConfig
from lerobot.datasets import LeRobotDataset
from marks import CAMERAS, HEIGHT, WIDTH, Mark, picture

from lerobot_msdyn.dataset.video import tamed_av1

LENGTHS = (10, 12, 9, 11)
FPS = 30
ANY: frozenset[Mark] = frozenset()
Shown = dict[tuple[int, int], list[frozenset[Mark]]]  # (camera, episode) -> per row
Pictures = list[np.ndarray]
KEYS = [f"observation.images.{name}" for name in CAMERAS]
EPISODES = range(len(LENGTHS))
H264, AV1, HEVC = "libx264", "libsvtav1", "libx265"


@dataclass
class Fault:
    """What was done to a dataset."""

    what: str
    shown: Shown
    flags: list[str] = field(default_factory=list)
    whole: bool = False  # whether it must be rendered
    interrupt_s: float = 0.0  # of processor time, after which the run is interrupted first


def as_recorded() -> Shown:
    """Every row shows its own frame."""
    return {
        (camera, episode): [frozenset({(camera, episode, t)}) for t in range(LENGTHS[episode])]
        for camera in range(len(CAMERAS))
        for episode in EPISODES
    }


def drawn(camera: int, episode: int) -> Pictures:
    """The pictures of an episode."""
    return [picture((camera, episode, t)) for t in range(LENGTHS[episode])]


def record(root: Path, codec: str = "h264", *, depth: bool = False) -> None:
    """A dataset of pictures with marks; the state holds the episode's and the frame's number."""
    axes = ["height", "width", "channels"]
    vector = {"dtype": "float32", "shape": (3,), "names": ["episode", "frame", "x"]}
    features: dict[str, dict] = {"observation.state": vector, "action": dict(vector)}
    features |= {key: {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": axes} for key in KEYS}
    if depth:
        info = {"is_depth_map": True}
        shape = (HEIGHT, WIDTH, 1)
        features[f"{KEYS[0]}_depth"] = {"dtype": "video", "shape": shape, "names": axes, "info": info}
    dataset = LeRobotDataset.create(
        "local/ds",
        FPS,
        features,
        root=root,
        robot_type="marks",
        video_backend="pyav",
        rgb_encoder=RGBEncoderConfig(vcodec=codec),
        depth_encoder=DepthEncoderConfig(extra_options={"x265-params": "lossless=1:log-level=error"}),
    )
    for episode in EPISODES:
        for t in range(LENGTHS[episode]):
            state = np.array([episode, t, 4 + 3 * t], np.float32)
            frame: dict[str, Any] = {"observation.state": state, "action": state, "task": "Push it."}
            frame |= {key: picture((camera, episode, t)) for camera, key in enumerate(KEYS)}
            if depth:
                frame[f"{KEYS[0]}_depth"] = np.full((HEIGHT, WIDTH, 1), 600, np.uint16)
            dataset.add_frame(frame)
        with tamed_av1():
            dataset.save_episode(parallel_encoding=False)
    dataset.finalize()


@dataclass
class Encoding:
    """How a video file is written; every frame is a key frame unless the options say otherwise."""

    codec: str = H264
    pix_fmt: str = "yuv420p"
    options: dict[str, str] = field(default_factory=lambda: {"crf": "20", "g": "1"})
    full_range: bool = False
    timescale: int | None = None


def encode(path: Path, pictures: Iterable[np.ndarray], how: Encoding, times: Sequence[int] | None = None) -> None:
    """A video file; `times` are the frames' numbers, where some are left out."""
    path.parent.mkdir(parents=True, exist_ok=True)
    container_options = {} if how.timescale is None else {"video_track_timescale": str(how.timescale)}
    with av.open(str(path), "w", options=container_options) as container, tamed_av1():
        stream = container.add_stream(how.codec, FPS, options=how.options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, how.pix_fmt
        if how.full_range:
            stream.codec_context.color_range = 2
        for i, image in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            if how.full_range:
                frame = frame.reformat(format=how.pix_fmt, dst_color_range="JPEG")
            frame.pts, frame.time_base = i if times is None else times[i], Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def edit_episodes(root: Path, changes: dict[str, list[Any]]) -> None:
    """Replace columns of meta/episodes."""
    path = next((root / "meta" / "episodes").rglob("*.parquet"))
    table = pq.read_table(path)
    for name, values in changes.items():
        kind = table.schema.field(name).type
        table = table.set_column(table.column_names.index(name), name, pa.array(values, kind))
    pq.write_table(table, path)


def edit_info(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change meta/info.json."""
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info, indent=1))


def video_file(root: Path, key: str, number: int = 0) -> Path:
    return root / "videos" / key / "chunk-000" / f"file-{number:03d}.mp4"


def data_file(root: Path, number: int = 0) -> Path:
    return root / "data" / "chunk-000" / f"file-{number:03d}.parquet"


def lay_out(
    root: Path,
    camera: int,
    groups: Sequence[Sequence[int]],
    encodings: Sequence[Encoding],
    pictures: dict[int, Pictures] | None = None,
    *,
    nominal: bool = True,
) -> None:
    """Write one camera's videos anew: some episodes a file, each file encoded in its way.

    `nominal`: starts are those that the numbers of rows tell, else those that the pictures tell.
    """
    key = KEYS[camera]
    for path in (root / "videos" / key).rglob("*.mp4"):
        path.unlink()
    columns: dict[str, list[Any]] = {
        f"videos/{key}/{name}": [0] * len(LENGTHS)
        for name in ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    }
    for number, (group, how) in enumerate(zip(groups, encodings, strict=True)):
        frames: Pictures = []
        start = 0
        for episode in group:
            own = (pictures or {}).get(episode) or drawn(camera, episode)
            count = LENGTHS[episode] if nominal else len(own)
            columns[f"videos/{key}/file_index"][episode] = number
            columns[f"videos/{key}/from_timestamp"][episode] = start / FPS
            columns[f"videos/{key}/to_timestamp"][episode] = (start + count) / FPS
            start += count
            frames += own
        encode(video_file(root, key, number), frames, how)
    edit_episodes(root, columns)


def split_rows(root: Path, groups: Sequence[Sequence[int]]) -> None:
    """Write the rows anew: some episodes a file."""
    rows = pa.concat_tables([pq.read_table(path) for path in sorted((root / "data").rglob("*.parquet"))])
    owner = np.asarray(rows["episode_index"])
    places = [0] * len(LENGTHS)
    for number, group in enumerate(groups):
        pq.write_table(rows.filter(pa.array(np.isin(owner, list(group)))), data_file(root, number))
        for episode in group:
            places[episode] = number
    edit_episodes(root, {"data/file_index": places})


def edit_rows(root: Path, name: str, values_of: Callable[[int, np.ndarray], np.ndarray]) -> None:
    """Change a column of the rows, episode by episode."""
    for path in sorted((root / "data").rglob("*.parquet")):
        table = pq.read_table(path)
        owner, values = np.asarray(table["episode_index"]), np.asarray(table[name]).copy()
        for episode in np.unique(owner):
            values[owner == episode] = values_of(int(episode), values[owner == episode])
        position = table.column_names.index(name)
        table = table.set_column(position, name, pa.array(values, table.schema.field(name).type))
        pq.write_table(table, path)


def random_groups(rng: random.Random) -> list[list[int]]:
    """The episodes in two to four files, in their order."""
    cuts = sorted(rng.sample(range(1, len(LENGTHS)), rng.randint(1, len(LENGTHS) - 1)))
    return [list(EPISODES[a:b]) for a, b in zip([0, *cuts], [*cuts, len(LENGTHS)], strict=True)]


def intact(root: Path, rng: random.Random) -> Fault:
    """Nothing: what the others are compared with."""
    return Fault("nothing", as_recorded())


def interrupted(root: Path, rng: random.Random) -> Fault:
    """Ctrl-C, and the same command again."""
    after = rng.uniform(0.01, 1.5)
    return Fault(f"after {after:.2f} s", as_recorded(), interrupt_s=after)


def mixed_codecs(root: Path, rng: random.Random) -> Fault:
    """Files of one camera in several codecs, pixel formats, key frame distances or time bases."""
    ways = [
        Encoding(),
        Encoding(AV1, options={"crf": "30", "preset": "12", "g": "1", "svtav1-params": "lp=1"}),
        Encoding(HEVC, options={"crf": "20", "g": "1", "x265-params": "log-level=error:pools=1"}),
        Encoding(pix_fmt="yuv444p"),
        Encoding("mpeg4", options={"q:v": "3", "g": "1"}),
        Encoding(timescale=rng.choice([90000, 15360, 600])),
        Encoding(options={"crf": "20", "g": "50", "bf": "3"}),
        Encoding(full_range=True),
    ]
    cameras = rng.choice([[0], [1], [0, 1]])
    said = []
    for camera in cameras:
        groups = random_groups(rng)
        chosen = [rng.choice(ways) for _ in groups]
        lay_out(root, camera, groups, chosen)
        said.append(f"{CAMERAS[camera]} {groups} {[(w.codec, w.pix_fmt, w.full_range, w.timescale) for w in chosen]}")
    return Fault("; ".join(said), as_recorded())


def clock(root: Path, rng: random.Random) -> Fault:
    """Times of rows that jitter, drift, jump, or are of another clock."""
    kind = rng.choice(["jitter", "offset", "drift", "epoch", "late", "jitter and offset"])
    size = rng.choice([2e-4, 1e-3, 5e-3, 0.012])
    noise = np.random.default_rng(rng.randrange(2**32))
    episodes = rng.choice([list(EPISODES), rng.sample(EPISODES, 1)])
    offset = rng.choice([-1, 1]) * rng.uniform(0.01, 2.0)

    def times(episode: int, values: np.ndarray) -> np.ndarray:
        if episode not in episodes:
            return values
        if kind == "epoch":
            return values + 1.7e9
        if kind == "drift":
            return values * (1 + size)
        if kind == "late":
            return values + np.where(np.arange(len(values)) > len(values) // 2, 1 / FPS, 0)
        jitter = noise.normal(0, size, len(values)) if "jitter" in kind else 0
        return values + jitter + (offset if "offset" in kind else 0)

    edit_rows(root, "timestamp", times)
    flags = [f"--tolerance_s={4 * size}"] if rng.random() < 0.2 else []
    return Fault(f"{kind} of {size} s, offset {offset:.3f} s, episodes {episodes}", as_recorded(), flags)


def off_grid(root: Path, rng: random.Random) -> Fault:
    """Starts of episodes in a file that are off the file's frames, by as much for each, or more with every episode."""
    step = rng.choice([-1, 1]) * rng.choice([0.1, 0.3, 0.5, 0.51, 0.9]) / FPS
    growing = rng.random() < 0.6
    changes = {}
    for key in rng.choice([[KEYS[0]], [KEYS[1]], KEYS]):
        starts = np.cumsum([0, *LENGTHS[:-1]]) / FPS
        by = step * (np.arange(len(LENGTHS)) if growing else 1)
        changes[f"videos/{key}/from_timestamp"] = list(np.maximum(0, starts + by))
        changes[f"videos/{key}/to_timestamp"] = list(np.maximum(0, starts + by) + np.array(LENGTHS) / FPS)
    edit_episodes(root, changes)
    return Fault(f"by {1000 * step:.1f} ms, growing {growing}, {len(changes) // 2} cameras", as_recorded())


def between_key_frames(root: Path, rng: random.Random) -> Fault:
    """Episodes that start between key frames of a file with B-frames."""
    options = {
        "crf": "20",
        "g": rng.choice(["12", "50", "250"]),
        "bf": rng.choice(["0", "2", "4"]),
        "sc_threshold": "0",
    }
    if rng.random() < 0.3:
        options["x264-params"] = "open-gop=1"
    how = Encoding(options=options, full_range=rng.random() < 0.5, pix_fmt=rng.choice(["yuv420p", "yuv444p"]))
    for camera in rng.choice([[0], [1], [0, 1]]):
        groups = rng.choice([[list(EPISODES)], random_groups(rng)])
        lay_out(root, camera, groups, [how] * len(groups))
    return Fault(f"{options}, full range {how.full_range}", as_recorded())


def dropped_frames(root: Path, rng: random.Random) -> Fault:
    """A video with fewer frames than its episode has rows."""
    camera, episode = rng.randrange(2), rng.choice(EPISODES)
    lost = sorted(rng.sample(range(LENGTHS[episode]), rng.choice([1, 1, 2, 3])))
    way = rng.choice(["closed up", "nominal starts", "gap in time", "own file"])
    kept = [image for t, image in enumerate(drawn(camera, episode)) if t not in lost]
    groups = [list(EPISODES)] if way != "own file" else [[e] for e in EPISODES]
    lay_out(root, camera, groups, [Encoding()] * len(groups), {episode: kept}, nominal=way != "closed up")
    shown = as_recorded()
    if way == "gap in time":
        starts = np.cumsum([0, *LENGTHS])
        times = [t for t in range(starts[-1]) if t not in [starts[episode] + i for i in lost]]
        pictures = [image for e in EPISODES for image in (kept if e == episode else drawn(camera, e))]
        encode(video_file(root, KEYS[camera]), pictures, Encoding(), times)
    return Fault(f"{way}: frames {lost} of episode {episode}, {CAMERAS[camera]}", shown)


def stale_file_index(root: Path, rng: random.Random) -> Fault:
    """An index of a data file that does not hold the episode."""
    groups = random_groups(rng)
    split_rows(root, groups)
    places = [next(i for i, group in enumerate(groups) if e in group) for e in EPISODES]
    for episode in rng.sample(EPISODES, rng.choice([1, 2])):
        places[episode] = rng.choice([i for i in range(len(groups) + 1) if i != places[episode]])
    edit_episodes(root, {"data/file_index": places})
    return Fault(f"{groups} said to lie in {places}", as_recorded())


QUARTERS = {
    90: (0, 1, -1, 0, HEIGHT, 0),
    180: (-1, 0, 0, -1, WIDTH, HEIGHT),
    270: (0, -1, 1, 0, 0, WIDTH),
}


def display_matrix(root: Path, rng: random.Random) -> Fault:
    """A rotation in a file's header, as phones write it."""
    angle = rng.choice(list(QUARTERS))
    a, b, c, d, x, y = (value << 16 for value in QUARTERS[angle])
    matrix = b"".join(v.to_bytes(4, "big", signed=True) for v in (a, b, 0, c, d, 0, x, y, 1 << 30))
    cameras = rng.choice([[0], [1], [0, 1]])
    for camera in cameras:
        groups = rng.choice([[list(EPISODES)], random_groups(rng)])
        lay_out(root, camera, groups, [Encoding()] * len(groups))
        for number in range(len(groups)) if rng.random() < 0.7 else [0]:
            path = video_file(root, KEYS[camera], number)
            content = bytearray(path.read_bytes())
            at = content.index(b"tkhd") + 44
            content[at : at + 36] = matrix
            path.write_bytes(content)
    return Fault(f"{angle} degrees, {[CAMERAS[camera] for camera in cameras]}", as_recorded())


def moved_camera(root: Path, rng: random.Random) -> Fault:
    """A camera that is bumped, drifts, or stands elsewhere in later episodes."""
    kind = rng.choice(["bump", "drift", "between episodes"])
    by = (rng.choice([-1, 1]) * rng.choice([2, 4, 8]), rng.choice([-6, -3, 0, 3, 6]))
    since = rng.choice(EPISODES)
    chosen = [since] if kind != "between episodes" else [e for e in EPISODES if e >= since]
    pictures = {}
    for episode in chosen:
        length, start = LENGTHS[episode], rng.randrange(2, LENGTHS[episode] - 1)
        share = {
            "bump": [float(t >= start) for t in range(length)],
            "drift": [t / (length - 1) for t in range(length)],
            "between episodes": [1.0] * length,
        }[kind]
        shifts = [(round(by[0] * s), round(by[1] * s)) for s in share]
        pictures[episode] = [picture((0, episode, t), shifts[t]) for t in range(length)]
    lay_out(root, 0, [list(EPISODES)], [Encoding()], pictures)
    return Fault(f"{kind} by {by} px, episodes {chosen}", as_recorded(), whole=True)


def bad_pictures(root: Path, rng: random.Random) -> Fault:
    """Pictures that are black, uniform, frozen, of another brightness, or of the episode before."""
    kind = rng.choice(["black", "uniform", "frozen", "exposure", "first of the one before", "noise"])
    episode = rng.choice(EPISODES[1:])
    length = LENGTHS[episode]
    start = 0 if kind == "first of the one before" else rng.randrange(length)
    count = 1 if kind == "first of the one before" else rng.choice([1, 2, length - start])
    images, shown = drawn(0, episode), as_recorded()
    noise = np.random.default_rng(rng.randrange(2**32))
    gain = rng.choice([0.5, 0.7, 1.3])
    for t in range(start, min(length, start + count)):
        row = shown[0, episode]
        if kind == "frozen":
            images[t] = images[max(0, start - 1)]
            row[t] = frozenset({(0, episode, max(0, start - 1))})
        elif kind == "exposure":
            images[t] = (images[t] * gain).clip(0, 255).astype(np.uint8)
        elif kind == "first of the one before":
            images[t] = drawn(0, episode - 1)[-1]
            row[t] = frozenset({(0, episode - 1, LENGTHS[episode - 1] - 1)})
        else:
            level = {"black": 0, "uniform": rng.choice([60, 128, 255])}.get(kind)
            images[t] = np.full_like(images[t], level) if level is not None else _noise(noise)
            row[t] = ANY
    lay_out(root, 0, [list(EPISODES)], [Encoding()], {episode: images})
    return Fault(f"{kind}, {count} frames from {start} on of episode {episode}", shown, whole=True)


def _noise(noise: np.random.Generator) -> np.ndarray:
    return noise.integers(100, 156, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def recorder_killed(root: Path, rng: random.Random) -> Fault:
    """Metadata that promise more than is there, and last files that were never finished."""
    last = len(LENGTHS) - 1
    groups = [list(EPISODES[:last]), [last]]
    said = []
    split_rows(root, groups)
    for camera in range(len(CAMERAS)):
        lay_out(root, camera, groups, [Encoding()] * 2)
    for path in [data_file(root, 1), *(video_file(root, key, 1) for key in KEYS)]:
        state = rng.choice(["whole", "cut", "cut", "absent", "empty"])
        content = path.read_bytes()
        if state == "absent":
            path.unlink()
        elif state != "whole":
            path.write_bytes(content[: 0 if state == "empty" else len(content) * 2 // 3])
        said.append(f"{path.relative_to(root)} {state}")
    promised = rng.choice([0, 1, 80])
    listed = rng.random() < 0.5
    if not listed:
        path = next((root / "meta" / "episodes").rglob("*.parquet"))
        pq.write_table(pq.read_table(path).slice(0, last), path)
    if rng.random() < 0.3:
        extra = root / "meta" / "episodes" / "chunk-000" / "file-001.parquet"
        extra.write_bytes(b"PAR1 cut off")
        said.append("meta/episodes/chunk-000/file-001.parquet cut")

    def promise(info: dict[str, Any]) -> None:
        info["total_episodes"] += promised
        info["total_frames"] += promised * 10
        info["splits"] = {"train": f"0:{info['total_episodes']}"}

    edit_info(root, promise)
    return Fault(f"{promised} more promised, last listed {listed}, {', '.join(said)}", as_recorded())


def metadata(root: Path, rng: random.Random) -> Fault:
    """Names that are null, statistics that are absent, depth that is named in an old way."""
    said = []
    if rng.random() < 0.5:
        infos = json.loads((root / "meta" / "info.json").read_text())
        chosen = rng.sample(sorted(infos["features"]), rng.choice([1, 3, len(infos["features"])]))

        def unname(info: dict[str, Any]) -> None:
            for name in chosen:
                info["features"][name]["names"] = None

        edit_info(root, unname)
        said.append(f"no names of {chosen}")
    if rng.random() < 0.5:
        keys = rng.choice([[KEYS[0]], [KEYS[1]], KEYS, ["observation.state"]])
        where = rng.choice(["stats.json", "episodes", "both", "no file"])
        stats = root / "meta" / "stats.json"
        if where in ("stats.json", "both"):
            content = json.loads(stats.read_text())
            stats.write_text(json.dumps({name: value for name, value in content.items() if name not in keys}))
        if where in ("episodes", "both"):
            path = next((root / "meta" / "episodes").rglob("*.parquet"))
            table = pq.read_table(path)
            gone = [name for name in table.column_names if any(name.startswith(f"stats/{key}/") for key in keys)]
            pq.write_table(table.drop_columns(gone), path)
        if where == "no file":
            stats.unlink()
        said.append(f"no statistics of {keys} in {where}")
    depth = f"{KEYS[0]}_depth"
    spelling = rng.choice(["is_depth_map", "video.is_depth_map", "video_info", "old and new"])

    def spell(info: dict[str, Any]) -> None:
        feature = info["features"].get(depth)
        if feature is None or spelling == "is_depth_map":
            return
        inner = feature["info"]
        inner.pop("is_depth_map", None)
        inner["video.is_depth_map"] = True
        if spelling == "video_info":
            feature["video_info"] = feature.pop("info")
        elif spelling == "old and new":
            feature["video_info"] = {"video.is_depth_map": inner.pop("video.is_depth_map")}

    edit_info(root, spell)
    said.append(f"depth by {spelling}")
    return Fault("; ".join(said), as_recorded())


KINDS: dict[str, Callable[[Path, random.Random], Fault]] = {
    kind.__name__: kind
    for kind in (
        intact,
        interrupted,
        mixed_codecs,
        clock,
        off_grid,
        between_key_frames,
        dropped_frames,
        stale_file_index,
        display_matrix,
        moved_camera,
        bad_pictures,
        recorder_killed,
        metadata,
    )
}


def base_of(kind: str, rng: random.Random) -> str:
    """Which recorded dataset a kind starts from."""
    return "marks_depth" if kind == "metadata" else rng.choice(["marks_h264", "marks_av1"])
