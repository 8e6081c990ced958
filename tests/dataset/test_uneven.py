"""Sources that are not as clean as LeRobot's recorder makes them: every row keeps its own picture, or is left out."""

import json
import re
import shutil
import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from barcodes import (
    FPS,
    FRONT,
    SIDE,
    change_table,
    code_of,
    episodes_table,
    place,
    record,
    video_of,
    write_video,
)
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.core.errors import DatasetError, EpisodeError, OutputError
from lerobot_msdyn.dataset.provenance import SOURCE_VARIANT, Provenance, read_provenance
from lerobot_msdyn.dataset.read import open_source, read_colour
from lerobot_msdyn.dataset.rows import TIMESTAMP_TOLERANCE_S, read_rows
from lerobot_msdyn.dataset.video_index import UPRIGHT, Packet, Placed, VideoIndex, decoded, frame_numbers, index_of
from lerobot_msdyn.dataset.write import NewEpisode, OutputDataset

LENGTHS = (6, 5, 7)
BOTH = (FRONT, SIDE)


def readable(root: Path, tolerance_s: float = TIMESTAMP_TOLERANCE_S) -> dict[int, str]:
    """Per episode why it cannot be read, or nothing; what is read shows the code of its row."""
    source = open_source("local/bars", root, tolerance_s)
    problems = {}
    for index in range(source.total_episodes):
        try:
            rows = read_rows(source, index)
            for key in source.video_keys:
                codes = [code_of(frame) for frame in read_colour(source, index, key, rows)]
                assert codes == [int(action) for action in np.ravel(rows["action"].to_pylist())], (index, key)
            problems[index] = ""
        except EpisodeError as error:
            problems[index] = str(error)
    return problems


def written(root: Path, out: Path, tolerance_s: float = TIMESTAMP_TOLERANCE_S) -> LeRobotDataset:
    """Each readable episode as it is and once more with new pictures of the first camera, read by LeRobot itself."""
    source = open_source("local/bars", root, tolerance_s)
    key = source.video_keys[0]
    episodes = []
    with OutputDataset(source, "local/new", out) as output:
        output.check([key], depth=False)
        for index, problem in readable(root, tolerance_s).items():
            if problem:
                with pytest.raises(EpisodeError):
                    output.copies(index)
                continue
            frames = read_colour(source, index, key, read_rows(source, index)).flip(1).numpy()
            new = output.stage(index, 0, ({key: frame} for frame in frames), Provenance("local/bars", index, 0, 0))
            episodes += [NewEpisode(index, Provenance("local/bars", index, SOURCE_VARIANT, 0)), new]
        output.finish(episodes, "")
    dataset = LeRobotDataset("local/new", root=out, video_backend="pyav")
    for row in range(len(dataset)):
        item = dataset[row]
        for camera in source.video_keys:
            shown = (item[camera] * 255).permute(1, 2, 0)
            assert code_of(shown) == int(item["action"]), (row, camera)
            levels = np.sort(np.asarray(shown).mean((0, 2)).reshape(8, -1)[:, 2:-2].mean(1))
            assert abs(levels[0] - 30) < 8, "the colours have changed"
            assert abs(levels[-1] - 220) < 8, "the colours have changed"
    assert len(dataset) == 2 * sum(len(read_rows(source, index)) for index in {e.source_index for e in episodes})
    return dataset


# --- several codecs and pixel formats


@pytest.mark.parametrize(
    ("codec", "pix_fmt", "full_range"),
    [("libx264", "yuv420p", False), ("libx264", "yuv444p", False), ("libx264", "yuvj420p", True)],
)
def test_a_camera_in_two_codecs(tmp_path: Path, codec: str, pix_fmt: str, full_range: bool) -> None:
    episodes = record(tmp_path / "bars", LENGTHS, BOTH, "libsvtav1")
    first = video_of(tmp_path / "bars")
    second = first.with_name("file-001.mp4")
    write_video(second, episodes[1], codec, pix_fmt, full_range=full_range)
    table = episodes_table(tmp_path / "bars")
    change_table(table, {f"videos/{FRONT}/file_index": [0, 1, 0]})
    place(tmp_path / "bars", [0, 0, 1.1], [0.6, 0.5, 1.8])
    written(tmp_path / "bars", tmp_path / "new")
    made = [index_of(path).coding[:3] for path in sorted((tmp_path / "new" / "videos" / FRONT).rglob("*.mp4"))]
    assert len(made) == 3
    assert len(set(made)) == 2


def test_videos_that_cannot_be_put_together_get_files_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot_msdyn.dataset import write

    record(tmp_path / "bars", LENGTHS)

    def faulty(parts: list[Path], path: Path) -> None:
        raise av.error.InvalidDataError(1, "non monotonically increasing dts")

    monkeypatch.setattr(write, "concatenate_video_files", faulty)
    written(tmp_path / "bars", tmp_path / "new")
    assert len(list((tmp_path / "new" / "videos").rglob("*.mp4"))) == 2 * len(LENGTHS)


def test_what_cannot_be_encoded_is_said_before_any_work(tmp_path: Path) -> None:
    record(tmp_path / "bars", LENGTHS)
    path = tmp_path / "bars" / "meta" / "info.json"
    info = json.loads(path.read_text())
    info["features"][FRONT]["info"]["video.codec"] = "vp9"
    path.write_text(json.dumps(info))
    source = open_source("local/bars", tmp_path / "bars")
    with OutputDataset(source, "local/new", tmp_path / "new") as output:
        with pytest.raises(OutputError, match=f"{FRONT}: cannot encode video like its source"):
            output.check([FRONT], depth=False)
        output.finish([NewEpisode(1, Provenance("local/bars", 1, SOURCE_VARIANT, 0))], "")  # a copy needs no encoder


def test_a_size_that_the_codec_does_not_have_is_said_before_any_work(tmp_path: Path) -> None:
    record(tmp_path / "bars", LENGTHS)
    path = tmp_path / "bars" / "meta" / "info.json"
    info = json.loads(path.read_text())
    info["features"][FRONT]["shape"] = [47, 63, 3]
    info["features"][FRONT]["info"] |= {"video.codec": "h264", "video.pix_fmt": "yuv420p"}
    path.write_text(json.dumps(info))
    source = open_source("local/bars", tmp_path / "bars")
    with (
        OutputDataset(source, "local/new", tmp_path / "new") as output,
        pytest.raises(OutputError, match=f"new videos of {FRONT} cannot be encoded as the source's are"),
    ):
        output.check([FRONT], depth=False)


def test_tasks_that_are_no_texts_are_said_at_the_start(tmp_path: Path) -> None:
    record(tmp_path / "bars", LENGTHS)
    path = episodes_table(tmp_path / "bars")
    table = pq.read_table(path)
    pq.write_table(table.set_column(table.column_names.index("tasks"), "tasks", pa.array([1, 2, 3])), path)
    with pytest.raises(DatasetError, match="column tasks holds int64; expected lists of texts"):
        open_source("local/bars", tmp_path / "bars")


def test_data_files_of_different_types(tmp_path: Path) -> None:
    record(tmp_path / "bars", LENGTHS)
    path = next((tmp_path / "bars" / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.slice(0, 6), path)
    position = table.column_names.index("timestamp")
    wide = table.slice(6).set_column(position, "timestamp", table["timestamp"].slice(6).cast(pa.float64()))
    pq.write_table(wide, path.with_name("file-001.parquet"))
    change_table(episodes_table(tmp_path / "bars"), {"data/file_index": [0, 1, 1]})
    written(tmp_path / "bars", tmp_path / "new")


# --- times


@pytest.mark.parametrize("kind", ["jitter", "clock", "still"])
def test_times_off_the_grid_are_replaced(tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture) -> None:
    record(tmp_path / "bars", LENGTHS)
    path = next((tmp_path / "bars" / "data").rglob("*.parquet"))
    times = pq.read_table(path)["timestamp"].to_numpy()
    rng = np.random.default_rng(0)
    times = {
        "jitter": times + rng.uniform(-0.004, 0.004, len(times)),
        "clock": 1.7 * times + 1.3,
        "still": 0 * times,
    }[kind]
    change_table(path, {"timestamp": times.astype(np.float32)})
    dataset = written(tmp_path / "bars", tmp_path / "new")
    for row in range(len(dataset)):
        assert dataset[row]["timestamp"] == np.float32(int(dataset[row]["frame_index"]) / FPS)
    said = [record.getMessage() for record in caplog.records if "off frame_index / fps" in record.getMessage()]
    assert len(said) == len(LENGTHS)
    kept = [row["times_replaced_s"] for row in read_provenance(tmp_path / "new") or []]
    assert all(0.001 < off < 2 for off in kept)


def test_times_on_the_grid_are_kept_bit_for_bit(tmp_path: Path) -> None:
    record(tmp_path / "bars", LENGTHS)
    path = next((tmp_path / "bars" / "data").rglob("*.parquet"))
    times = pq.read_table(path)["timestamp"].to_numpy() + np.float32(2e-5)
    change_table(path, {"timestamp": times})
    written(tmp_path / "bars", tmp_path / "new")
    source = open_source("local/bars", tmp_path / "bars")
    new = open_source("local/new", tmp_path / "new")
    assert read_rows(new, 2)["timestamp"].equals(read_rows(source, 1)["timestamp"])
    assert [row["times_replaced_s"] for row in read_provenance(new.root) or []] == [0.0] * 6


def test_a_video_of_twice_the_rate_is_told_by_times(tmp_path: Path) -> None:
    (codes,) = record(tmp_path / "bars", [6])
    twice = [code for code in codes for _ in range(2)]
    write_video(video_of(tmp_path / "bars"), twice, fps=2 * FPS)
    written(tmp_path / "bars", tmp_path / "new")
    path = next((tmp_path / "bars" / "data").rglob("*.parquet"))
    times = pq.read_table(path)["timestamp"].to_numpy() + np.float32(0.004)
    change_table(path, {"timestamp": times})
    assert "up to 0.0040 s from the rows' times; --tolerance_s allows it" in readable(tmp_path / "bars")[0]
    written(tmp_path / "bars", tmp_path / "tolerant", 0.01)


@pytest.mark.parametrize("drift", [0.017, -0.011])
def test_starts_off_the_grid(tmp_path: Path, drift: float) -> None:
    """More with every episode, up to more than half a frame."""
    lengths = (5, 5, 5, 5, 5)
    record(tmp_path / "bars", lengths)
    starts = [max(0.0, 0.5 * i + drift * i) for i in range(5)]
    place(tmp_path / "bars", starts, [start + 0.5 for start in starts])
    written(tmp_path / "bars", tmp_path / "new")


def test_a_start_that_drifts_by_a_whole_frame_is_not_believed(tmp_path: Path) -> None:
    """Half a frame more with every episode: the third starts exactly on a frame, which is the second of its own."""
    record(tmp_path / "bars", (5, 5, 5, 5))
    starts = [0.5 * i + 0.05 * i for i in range(4)]
    place(tmp_path / "bars", starts, [start + 0.5 for start in starts])
    problems = readable(tmp_path / "bars")
    assert not problems[0]
    assert "it starts at 0.5500 s" in problems[1]
    assert "it starts at 1.1000 s" in problems[2]
    assert "by counting frames at 1.0000 s" in problems[2]
    assert "it starts at 1.6500 s" in problems[3]


def test_a_start_between_two_frames_that_is_nobodys(tmp_path: Path) -> None:
    episodes = record(tmp_path / "bars", LENGTHS)
    write_video(video_of(tmp_path / "bars"), [code for codes in episodes for code in codes][:-1])
    place(tmp_path / "bars", [0, 0.645, 1.1], [0.645, 1.1, 1.7])
    problems = readable(tmp_path / "bars")
    assert "it starts at 0.6450 s" in problems[1]
    assert "6 video frames for 7 rows" in problems[2]


# --- key frames


@pytest.mark.parametrize("full_range", [False, True])
@pytest.mark.parametrize(
    "options", [{"bf": "3", "x264-params": "b-adapt=0"}, {"bf": "2", "g": "8", "x264-params": "open-gop=1:b-adapt=0"}]
)
def test_episodes_that_start_between_key_frames(tmp_path: Path, options: dict[str, str], full_range: bool) -> None:
    episodes = record(tmp_path / "bars", LENGTHS)
    codes = [code for episode in episodes for code in episode]
    pix_fmt = "yuvj420p" if full_range else "yuv420p"
    write_video(video_of(tmp_path / "bars"), codes, "libx264", pix_fmt, options=options, full_range=full_range)
    video = index_of(video_of(tmp_path / "bars"))
    assert [packet.pts for packet in video.packets] != video.shown, "no B-frames"
    for number in range(len(codes)):
        assert code_of(next(decoded(video, [number]))) == codes[number]
    every_tenth = range(0, len(codes), 10)
    assert [code_of(picture) for picture in decoded(video, every_tenth)] == codes[::10]
    written(tmp_path / "bars", tmp_path / "new")


def test_new_videos_have_the_colours_of_a_full_range_source(tmp_path: Path) -> None:
    path = tmp_path / "bars" / "meta" / "info.json"
    for pix_fmt in ("yuvj420p", "yuv420p"):
        shutil.rmtree(tmp_path, ignore_errors=True)
        episodes = record(tmp_path / "bars", LENGTHS)
        codes = [code for episode in episodes for code in episode]
        write_video(video_of(tmp_path / "bars"), codes, "libx264", "yuvj420p", options={"g": "2"}, full_range=True)
        info = json.loads(path.read_text())
        info["features"][FRONT]["info"] |= {"video.codec": "h264", "video.pix_fmt": pix_fmt}
        path.write_text(json.dumps(info))
        written(tmp_path / "bars", tmp_path / "new")


# --- frames that are not there, or too many


def lossy(root: Path, episodes: list[list[int]], kept: list[list[int]]) -> None:
    """Episodes in one file that has other frames than rows; metadata follows the file, as LeRobot writes it."""
    write_video(video_of(root, SIDE), [code for codes in kept for code in codes])
    ends = np.cumsum([len(codes) for codes in kept]) / FPS
    place(root, [0, *ends[:-1]], list(ends), SIDE)
    assert len(episodes) == len(kept)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_dropped_frames_cost_their_episode_only(tmp_path: Path, which: int) -> None:
    episodes = record(tmp_path / "bars", LENGTHS, BOTH)
    kept = [codes if i != which else [codes[0], *codes[3:]] for i, codes in enumerate(episodes)]
    lossy(tmp_path / "bars", episodes, kept)
    problems = readable(tmp_path / "bars")
    assert f"{SIDE}: {len(kept[which])} video frames for {LENGTHS[which]} rows" in problems[which]
    assert [bool(problem) for problem in problems.values()] == [i == which for i in range(3)]
    assert written(tmp_path / "bars", tmp_path / "new").num_episodes == 4


def test_frames_too_many_cost_their_episode_only(tmp_path: Path) -> None:
    episodes = record(tmp_path / "bars", LENGTHS, BOTH)
    lossy(tmp_path / "bars", episodes, [episodes[0], [*episodes[1], 99, 99], episodes[2]])
    problems = readable(tmp_path / "bars")
    assert "7 video frames for 5 rows" in problems[1]
    assert not problems[0] + problems[2]


def test_as_many_dropped_as_added(tmp_path: Path) -> None:
    episodes = record(tmp_path / "bars", LENGTHS, BOTH)
    lossy(tmp_path / "bars", episodes, [episodes[0][:-2], [*episodes[1], 99, 99], episodes[2]])
    problems = readable(tmp_path / "bars")
    assert "4 video frames for 6 rows" in problems[0]
    assert "7 video frames for 5 rows" in problems[1]
    assert not problems[2]


def test_frames_that_nobody_can_tell_apart(tmp_path: Path) -> None:
    """Metadata counts rows, not frames: the file is too short, and any episode may have lost them."""
    episodes = record(tmp_path / "bars", LENGTHS, BOTH)
    write_video(video_of(tmp_path / "bars", SIDE), [*episodes[0][:4], *episodes[1], *episodes[2]])
    problems = readable(tmp_path / "bars")
    assert all("16 video frames for 18 rows of its 3 episodes" in problem for problem in problems.values())


def test_two_episodes_at_one_place(tmp_path: Path) -> None:
    record(tmp_path / "bars", (5, 5, 5))
    place(tmp_path / "bars", [0, 0, 1.0], [0.5, 0.5, 1.5])
    problems = readable(tmp_path / "bars")
    assert "starts where episode 1 starts" in problems[0]
    assert "starts where episode 0 starts" in problems[1]
    assert not problems[2]


def test_frames_of_no_episode_are_left_over(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    episodes = record(tmp_path / "bars", LENGTHS)
    write_video(video_of(tmp_path / "bars"), [*episodes[0], 99, 99, *episodes[1], *episodes[2], 99])
    place(tmp_path / "bars", [0, 0.8, 1.3], [0.6, 1.3, 2.0])
    written(tmp_path / "bars", tmp_path / "new")
    assert [record.getMessage() for record in caplog.records if "video frames more" in record.getMessage()]


def test_gaps_where_frames_were_dropped(tmp_path: Path) -> None:
    (codes,) = record(tmp_path / "bars", [6])
    write_video(video_of(tmp_path / "bars"), [*codes[:2], *codes[4:]], times=[0, 0.1, 0.4, 0.5])
    assert "4 video frames for 6 rows" in readable(tmp_path / "bars")[0]


def video_at(times: list[float]) -> VideoIndex:
    packets = tuple(Packet(round(1000 * time), round(1000 * time), is_key=True) for time in times)
    return VideoIndex(Path("a.mp4"), packets, Fraction(1, 1000), (64, 48), "yuv420p", True, ())


def test_frames_are_dealt_out_in_order() -> None:
    """Whatever their times, where there is one for every row."""
    placed = [Placed(3, 0.0, 0.2, 2), Placed(5, 0.31, 0.6, 3)]
    video = video_at([0.0, 0.13, 0.25, 0.33, 0.52])
    assert frame_numbers(video, placed, 3, np.zeros(2), 10) == [0, 1]
    assert frame_numbers(video, placed, 5, np.zeros(3), 10) == [2, 3, 4]


# --- files


def test_rows_in_another_file_than_metadata_says(tmp_path: Path) -> None:
    record(tmp_path / "bars", LENGTHS)
    path = next((tmp_path / "bars" / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.slice(0, 6), path)
    pq.write_table(table.slice(6, 2), path.with_name("file-001.parquet"))  # the second episode in two pieces
    pq.write_table(table.slice(8), path.with_name("file-002.parquet"))
    change_table(episodes_table(tmp_path / "bars"), {"data/file_index": [0, 0, 9]})
    assert not any(readable(tmp_path / "bars").values())
    written(tmp_path / "bars", tmp_path / "new")


def test_rows_that_are_nowhere(tmp_path: Path) -> None:
    record(tmp_path / "bars", LENGTHS)
    path = next((tmp_path / "bars" / "data").rglob("*.parquet"))
    pq.write_table(pq.read_table(path).slice(0, 9), path)
    problems = readable(tmp_path / "bars")
    assert "has 3 rows; expected 5" in problems[1]
    assert "has 0 rows; expected 7" in problems[2]


def mark_as_turned(path: Path, matrix: tuple[int, ...]) -> None:
    """Set the display matrix in the header of an mp4 file, as phones do."""
    content = bytearray(path.read_bytes())
    start = content.index(b"tkhd") + 4
    assert content[start] == 0  # version
    content[start + 40 : start + 76] = struct.pack(">9i", *matrix)
    path.write_bytes(content)


@pytest.mark.parametrize("which", [FRONT, SIDE])
@pytest.mark.parametrize(
    ("matrix", "how"),
    [
        ((0, 1 << 16, 0, -1 << 16, 0, 0, 48 << 16, 0, 1 << 30), "turned by -?90 degrees"),
        ((-1 << 16, 0, 0, 0, -1 << 16, 0, 64 << 16, 48 << 16, 1 << 30), "turned by -?180 degrees"),
        ((1 << 16, 0, 0, 0, -1 << 16, 0, 0, 48 << 16, 1 << 30), "turned|mirrored"),
    ],
)
def test_a_video_that_is_marked_as_turned(tmp_path: Path, which: str, matrix: tuple[int, ...], how: str) -> None:
    record(tmp_path / "bars", LENGTHS, BOTH)
    path = video_of(tmp_path / "bars", which)
    mark_as_turned(path, matrix)
    for problem in readable(tmp_path / "bars").values():
        assert re.search(f"{which}: {path} is marked to be shown ({how})", problem), problem
    mark_as_turned(path, UPRIGHT)
    assert not any(readable(tmp_path / "bars").values())
