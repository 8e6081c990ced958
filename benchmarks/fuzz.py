"""Run the command on datasets that are broken in random ways, and see that it always ends well.

python benchmarks/fuzz.py [--count 2000] [--seed 0] [--numbers 17 94] [--limit 120]

Every run must end by itself within `--limit` seconds (give it more on a busy machine) with exit code 0, 1 or 2, show no
traceback, leave the source and everything beside the output as they were, and leave an output that LeRobot opens, or
none. Rendering is replaced by turning the recorded pictures upside down, but for every 50th run: what is tried is
reading and writing. Runs are made in processes of their own, 40 in each: one that crashes or hangs is counted, and the
next process goes on after it.
`--numbers` repeats single runs of the seed.
"""

# ruff: noqa: E402 (the environment is set before LeRobot reads it)

import argparse
import collections
import contextlib
import faulthandler
import io
import json
import logging
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
SCRATCH = Path(tempfile.mkdtemp(prefix="msdyn_fuzz_"))
os.environ["HF_HOME"] = str(SCRATCH / "hf")
os.environ["LEROBOT_MSDYN_CACHE"] = str(SCRATCH / "cache")

import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.augment import run as job
from lerobot_msdyn.core.cli import run_command
from lerobot_msdyn.dataset.provenance import Provenance, camera_pose
from lerobot_msdyn.dataset.read import read_episode
from lerobot_msdyn.dataset.write import NewEpisode
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset

GRACE_S = 30  # after the limit, a process that ignores it is killed
BATCH = 40
WHOLE_EVERY = 50
FRAMES, WIDTH, HEIGHT = 4, 32, 24
FLAGS = ["--workers=1", "--cameras=[front]", "--variants=1", "--fit.steps=1", "--fit.max_width=16"]
FLAGS += ["--scene.moving_gaussians=50"]
NASTY: list[Any] = [
    None, True, False, 0, -1, 1, 3, 0.5, -0.0, 1e308, 1e-300, float("nan"), float("inf"), 10**12, 2**63, 10**30,
    "", " ", "..", "../../..", "/etc/passwd", "a/b", "\x00", "\u202e", "x" * 5000, "{", "}", "{}", "{0}", "{a}", "%s",
    "v2.1", "v9.9", "video", "image", "float32", "object", "O", "U9", "int64", "language", [], [1], [[]], [0, 0, 0],
    [-1, 2, 3], [24, 32, 3], [10**9, 10**9, 3], [3, 24, 32], {}, {"a": 1},
    {"video.extra_options": {"x265-params": "csv=/tmp/x"}},
    "../{video_key}/{chunk_index}-{file_index}.mp4", "/tmp/{chunk_index}-{file_index}", "{chunk_index.__class__}",
    "{chunk_index!r}", "{chunk_index:999999999d}", "{video_key:>999999999}", "{episode_index}", "data/{chunk_index}",
]  # fmt: skip


def fake_episode(source: Any, index: int, cameras: list[str], recipe: Any, output: Any, *_: Any) -> list[NewEpisode]:
    """The recorded pictures upside down, staged as rendered ones would be."""
    episode = read_episode(source, index, cameras, recipe.camera)
    views = {key: view.rgb.flip(1).numpy() for key, view in episode.views.items()}
    frames = [{key: rgb[t] for key, rgb in views.items()} for t in range(len(episode))]
    poses = {key: camera_pose(view.camera, view.camera) for key, view in episode.views.items()}
    gate = {"views": {key: {"distance_m": 1.0} for key in views}, "rejected": []}
    origin = Provenance(source.repo_id, index, 0, 0, {key: {"yaw_deg": 0.0} for key in views}, {}, poses, gate)
    new = replace(output.stage(index, 0, iter(frames), origin), seconds={"judging": 0.0})
    return [NewEpisode(index, Provenance(source.repo_id, index, -1, 0)), new]


def spots(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """All places in nested JSON."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield (*path, key)
        yield from spots(item, (*path, key))


def mutate_json(path: Path, rng: random.Random) -> str:
    content = json.loads(path.read_text())
    *parents, last = rng.choice(list(spots(content)))
    target = content
    for key in parents:
        target = target[key]
    if rng.random() < 0.2:
        if isinstance(target, dict):
            del target[last]
        what = "removed"
    else:
        target[last] = rng.choice(NASTY)
        what = repr(target[last])[:40]
    path.write_text(json.dumps(content))
    return f"{'.'.join(map(str, (*parents, last)))} {what}"


def mutate_table(path: Path, rng: random.Random) -> str:
    table = pq.read_table(path)
    name = rng.choice(table.column_names)
    position = table.column_names.index(name)
    kind = rng.choice(["cell", "drop", "text", "null", "rename", "rows", "shuffle", "cell", "cell"])
    if kind == "drop":
        table = table.drop_columns([name])
    elif kind == "rename":
        table = table.rename_columns([f"{c}x" if c == name else c for c in table.column_names])
    elif kind == "rows":
        table = table.slice(0, rng.randrange(table.num_rows + 1))
    elif kind == "shuffle":
        table = table.take(pa.array(rng.choices(range(table.num_rows), k=table.num_rows)))
    else:
        values = table[name].to_pylist()
        row = rng.randrange(len(values))
        if kind == "text":
            column = pa.array([str(value) for value in values])
        elif kind == "null":
            column = pa.nulls(len(values))
        else:
            value = values[row]
            if isinstance(value, list) and value and rng.random() < 0.7:
                value[rng.randrange(len(value))] = float("nan")
            elif isinstance(value, list):
                values[row] = value[:-1] if rng.random() < 0.5 else None
            else:
                values[row] = rng.choice([None, 0, -1, 1, 5, 10**6, 10**12, float("nan"), float("inf"), 0.01, "x"])
            try:
                column = pa.array(values)
            except (pa.ArrowException, OverflowError, TypeError):
                column = pa.array([str(value) for value in values])
        table = table.set_column(position, name, column)
    pq.write_table(table, path)
    return f"{name} {kind}"


def mutate_bytes(path: Path, rng: random.Random) -> str:
    content = bytearray(path.read_bytes())
    kind = rng.choice(["cut", "empty", "flip", "flip", "noise", "text", "doubled"])
    if kind == "cut":
        content = content[: rng.randrange(len(content) + 1)]
    elif kind == "empty":
        content = bytearray()
    elif kind == "flip":
        for _ in range(rng.choice([1, 3, 30])):
            content[rng.randrange(len(content))] = rng.randrange(256)
    elif kind == "noise":
        content = bytearray(rng.randbytes(len(content)))
    elif kind == "text":
        content = bytearray(b'{"what": "this is not"}')
    else:
        content = content + content
    path.write_bytes(bytes(content))
    return f"bytes {kind}"


def mutate_file(path: Path, rng: random.Random) -> str:
    outside = path.parents[len(path.parents) - 1] / "etc" / "hostname"
    kind = rng.choice(["gone", "folder", "link out", "link nowhere", "link loop", "pipe", "device", "other"])
    other = rng.choice([file for file in sorted(path.parent.parent.rglob("*")) if file.is_file()])
    if kind == "other":
        shutil.copyfile(other, path) if other != path else None
        return kind
    path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind == "link out":
        path.symlink_to(outside)
    elif kind == "link nowhere":
        path.symlink_to("nowhere")
    elif kind == "link loop":
        path.symlink_to(path.name)
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    return kind


def mutate(root: Path, rng: random.Random) -> str:
    """Break something; returns what."""
    files = [path for path in sorted(root.rglob("*")) if path.is_file()]
    weights = [6 if path.name == "info.json" else 3 if "episodes" in path.parts else 1 for path in files]
    path = rng.choices(files, weights)[0]
    ways: list[Callable[[Path, random.Random], str]] = [mutate_bytes, mutate_file]
    if path.suffix == ".json":
        ways = [mutate_json] * 8 + ways
    if path.suffix == ".parquet":
        ways = [mutate_table] * 6 + ways
    return f"{path.relative_to(root)}: {rng.choice(ways)(path, rng)}"


def listing(root: Path) -> dict[str, tuple[Any, ...]]:
    """Everything in a folder, down to sizes and times."""
    return {
        str(path.relative_to(root)): (path.lstat().st_mode, path.lstat().st_size, path.lstat().st_mtime_ns)
        for path in sorted(root.rglob("*"))
    }


def break_copy(original: Path, place: Path, rng: random.Random) -> str:
    """A broken copy in `place`/ds; returns what was broken."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(original, place / "ds")
    broken = []
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        with contextlib.suppress(OSError, ValueError, KeyError, IndexError, TypeError, pa.ArrowException):
            broken.append(mutate(place / "ds", rng))  # the second may find the file unusable that the first broke
    return "; ".join(broken)


def command(place: Path, limit_s: int, *, whole: bool) -> tuple[int | None, list[str], str]:
    """Run the command on `place`/ds; the exit code, what went wrong, and what was said."""
    said, code, faults = io.StringIO(), None, []
    setattr(job, "augment_episode", REAL if whole else fake_episode)  # noqa: B010 (another signature)
    logging.basicConfig(level=logging.INFO, stream=said, force=True)
    begin = time.perf_counter()
    signal.alarm(limit_s)
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            names = ["--repo=local/ds", f"--root={place / 'ds'}", f"--new_root={place / 'out'}"]
            run_command(augment.run, [*names, *FLAGS])
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else None
    except BaseException as error:
        faults.append(f"{type(error).__name__} {error}")
    finally:
        signal.alarm(0)
    if time.perf_counter() - begin > limit_s:
        faults.append(f"more than {limit_s} s")
    if code not in (0, 1, 2):
        faults.append(f"exit code {code}")
    text = said.getvalue()
    if "Traceback" in text or "please report" in text:
        faults.append("traceback")
    if code == 2 and text.count("error: ") != 1:
        faults.append("not one line")
    return code, faults, text


def trial(place: Path, limit_s: int, *, whole: bool) -> tuple[int | None, list[str], str]:
    """The command on the broken copy in `place`, and all that it must not have done."""
    source, out = place / "ds", place / "out"
    before, here = listing(source), set(listing(Path.cwd()))
    code, faults, text = command(place, limit_s, whole=whole)
    if listing(source) != before:
        faults.append("the source was touched")
    there = {path.name for path in place.iterdir()}
    if there - {"ds"} != ({"out"} if code in (0, 1) else set()):
        faults.append(f"left behind: {sorted(there)}")
    if set(listing(Path.cwd())) != here:
        faults.append("a stray file")
    if code in (0, 1):
        try:
            dataset = LeRobotDataset("local/out", root=out, video_backend="pyav")
            assert len(dataset[i]) > 0 if (i := len(dataset) - 1) else True
        except Exception as error:
            faults.append(f"the output cannot be opened: {type(error).__name__} {error}")
    return code, faults, text


def batch(numbers: list[int], seed: int, limit_s: int, send: Connection) -> None:
    """Some trials; for each, what was broken is sent before it, and what came of it after it."""
    faulthandler.enable()
    signal.signal(signal.SIGALRM, late)
    for number in numbers:
        rng = random.Random(seed * 1_000_003 + number)
        send.send(break_copy(SCRATCH / ("image" if number % 4 == 3 else "video"), SCRATCH / "place", rng))
        send.send(trial(SCRATCH / "place", limit_s, whole=number % WHOLE_EVERY == 0))
    shutil.rmtree(SCRATCH / "hf", ignore_errors=True)


def late(*_: Any) -> None:
    """The limit is over."""
    raise TimeoutError("the limit is over")


def trials(numbers: list[int], seed: int, limit_s: int) -> Iterator[tuple[int, str, int | None, list[str], str]]:
    """Number, what was broken, exit code, faults and text of each trial, whatever it does to its process."""
    while numbers:
        receive, send = FORK.Pipe(duplex=False)
        process = FORK.Process(target=batch, args=(numbers[:BATCH], seed, limit_s, send))
        process.start()
        send.close()
        for number in numbers[:BATCH]:
            broken = "?"
            try:
                if not receive.poll(limit_s + GRACE_S):
                    raise TimeoutError
                broken = receive.recv()
                if not receive.poll(limit_s + GRACE_S):
                    raise TimeoutError
                outcome = receive.recv()
            except (TimeoutError, EOFError) as error:
                process.kill() if isinstance(error, TimeoutError) else None
                process.join()
                outcome = (process.exitcode, ["hangs" if isinstance(error, TimeoutError) else "crashes"], "")
            numbers = numbers[1:]
            yield number, broken, *outcome
            if process.exitcode is not None:
                break
        process.join()
        receive.close()


def write_originals() -> None:
    """The datasets to break: pictures as videos, and as images."""
    scenes = [make_scene("push", 0, FRAMES, WIDTH, HEIGHT, episode=index) for index in range(3)]
    for name, dtype in (("video", "video"), ("image", "image")):
        write_dataset(scenes, "local/ds", SCRATCH / name, cameras=["front", "side"], depth=True, image_dtype=dtype)
        (SCRATCH / name / "README.md").write_text("---\nlicense: mit\n---\nA desk.\n")
        for path in (SCRATCH / name / "meta" / "episodes").rglob("*.parquet"):  # read in a tenth of the time without
            table = pq.read_table(path)
            unused = [column for column in table.column_names if column.startswith("stats/")]
            pq.write_table(table.drop_columns(unused), path)


def main() -> int:
    """Print a summary; 0 if nothing went wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--numbers", type=int, nargs="+")
    parser.add_argument("--limit", type=int, default=120, help="seconds that a run may take")
    options = parser.parse_args()
    work = SCRATCH / "work"
    work.mkdir()
    os.chdir(work)
    writer = FORK.Process(target=write_originals)  # this process must not have threads of its own when it is copied
    writer.start()
    writer.join()
    numbers = options.numbers or list(range(options.count))
    codes: collections.Counter[int | None] = collections.Counter()
    bad = []
    begin = time.perf_counter()
    for done, (number, broken, code, faults, text) in enumerate(trials(numbers, options.seed, options.limit), 1):
        codes[code] += 1
        if faults:
            bad.append(number)
            print(f"{number}: {broken}: {'; '.join(faults)}\n{text[-1500:]}\n", flush=True)
        elif options.numbers:
            print(f"{number}: {broken}: exit code {code}\n{text[-1500:]}\n", flush=True)
        if done % 100 == 0:
            print(f"{done}: {dict(codes)}, {len(bad)} bad, {time.perf_counter() - begin:.0f} s", flush=True)
    print(f"{len(numbers)} broken datasets: exit codes {dict(codes)}; ended badly: {bad or 'none'}")
    os.chdir("/")
    shutil.rmtree(SCRATCH, ignore_errors=True)
    return int(bool(bad))


FORK = multiprocessing.get_context("fork")
REAL = job.augment_episode

if __name__ == "__main__":
    sys.exit(main())
