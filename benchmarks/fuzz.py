"""Run the command on datasets that are broken in random ways, and see that it always ends well.

python benchmarks/fuzz.py [--count 2000] [--seed 0] [--kinds random clock] [--numbers 17 94] [--limit 120]
                          [--results FILE] [--whole 5]

Kinds are those of `faults.py`, what recorders, merges and phones do, and `random` (values, files, bytes, links, pipes);
they take turns. Every run must end by itself within `--limit` seconds (give it more on a busy machine) with exit code
0, 1 or 2 (130 where it is interrupted), show no traceback, leave the source and everything beside the output as they
were, and leave an output that LeRobot opens, or none. In the output of all kinds but `random`, every picture must be
the one of its row, as its mark says (`marks.py`), and a trainer must find names and statistics.

Rendering is replaced by turning the recorded pictures upside down, but for every 50th run of `random`, one in `--whole`
of the others, and kinds that are about reconstruction. Runs are made in processes of their own, 40 in each: one that
crashes or hangs is counted, and the next process goes on after it.
`--numbers` repeats single runs of the seed. `--results` keeps a line of JSON per run, and runs nothing that is there.
"""

# ruff: noqa: E402 (the environment is set before LeRobot reads it)

import argparse
import collections
import contextlib
import faulthandler
import gc
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
from faults import KINDS, Fault, base_of, record
from judge import unfit_for_training, wrong_pictures
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.augment import run as job
from lerobot_msdyn.core.cli import run_command
from lerobot_msdyn.dataset.provenance import Provenance, camera_pose
from lerobot_msdyn.dataset.read import read_episode
from lerobot_msdyn.dataset.write import NewEpisode
from lerobot_msdyn.reconstruction.account import Account, MovingPixels
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset

GRACE_S = 30  # after the limit, a process that ignores it is killed
BATCH = 40
WHOLE_EVERY = 50
FRAMES, WIDTH, HEIGHT = 4, 32, 24
FLAGS = ["--workers=1", "--cameras=[front]", "--variants=1", "--fit.steps=1", "--fit.max_width=16"]
FLAGS += ["--scene.moving_gaussians=50"]
SMALL = ["--workers=1", "--cameras=[front]", "--variants=1", "--fit.steps=2", "--fit.max_width=64"]
SMALL += ["--scene.moving_gaussians=200", "--scene.moving_frames=4", "--gate.enabled=false"]
SMALL += ["--perturbation.azimuth_deg=0.3", "--perturbation.elevation_deg=0.2", "--perturbation.translation_rel=0.002"]
RANDOM = "random"
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
    nothing = Account(MovingPixels(), 0.0, 0.0, held_out=False).entry()
    gate = {"views": {key: {"distance_m": 1.0, "what_moves": nothing} for key in views}, "rejected": []}
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


def break_copy(original: Path, place: Path, rng: random.Random) -> Fault:
    """A copy in `place`/ds that is broken in random ways."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(original, place / "ds")
    broken = []
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        with contextlib.suppress(OSError, ValueError, KeyError, IndexError, TypeError, pa.ArrowException):
            broken.append(mutate(place / "ds", rng))  # the second may find the file unusable that the first broke
    return Fault("; ".join(broken), {})


def case_of(number: int, kind: str, seed: int, place: Path, whole_every: int) -> Fault:
    """Make one broken dataset in `place`/ds."""
    rng = random.Random(seed * 1_000_003 + number)
    if kind == RANDOM:
        fault = break_copy(SCRATCH / ("image" if number % 4 == 3 else "video"), place, rng)
        return replace(fault, flags=FLAGS, whole=number % WHOLE_EVERY == 0)
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(SCRATCH / base_of(kind, rng), place / "ds")
    fault = KINDS[kind](place / "ds", rng)
    return replace(fault, flags=[*SMALL, *fault.flags], whole=fault.whole or rng.random() * whole_every < 1)


def command(place: Path, limit_s: int, fault: Fault, *, interrupt_s: float = 0.0) -> tuple[int | None, list[str], str]:
    """Run the command on `place`/ds; the exit code, what went wrong, and what was said."""
    said, code, faults = io.StringIO(), None, []
    setattr(job, "augment_episode", REAL if fault.whole else fake_episode)  # noqa: B010 (another signature)
    logging.basicConfig(level=logging.INFO, stream=said, force=True)
    begin = time.perf_counter()
    signal.alarm(limit_s)
    signal.setitimer(signal.ITIMER_PROF, interrupt_s)
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            names = ["--repo=local/ds", f"--root={place / 'ds'}", f"--new_root={place / 'out'}"]
            run_command(augment.run, [*names, *fault.flags])
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else None
    except BaseException as error:
        faults.append(f"{type(error).__name__} {error}")
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
    if time.perf_counter() - begin > limit_s:
        faults.append(f"more than {limit_s} s")
    if code not in (0, 1, 2, *([130] if interrupt_s else [])):
        faults.append(f"exit code {code}")
    text = said.getvalue()
    if "Traceback" in text or "please report" in text:
        rest = text[max(text.find("Traceback"), 0) :].splitlines()
        faults.append("traceback: " + next((line for line in rest[1:] if line[:1].isalpha()), rest[0])[:200])
    if code == 2 and text.count("error: ") != 1:
        faults.append("not one line")
    return code, faults, text


def interrupted(place: Path, limit_s: int, fault: Fault) -> list[str]:
    """The command, interrupted: what was wrong, and whether it keeps what it says."""
    code, faults, text = command(place, limit_s, fault, interrupt_s=fault.interrupt_s)
    kept = (place / ".out.partial").exists()
    if code == 130 and kept != ("interrupted: kept in" in text):
        faults.append(f"interrupted, kept is {kept}: {text[-200:]}")
    if code == 0:
        shutil.rmtree(place / "out")
    return faults


def trial(place: Path, limit_s: int, fault: Fault) -> tuple[int | None, list[str], str]:
    """The command on the broken copy in `place`, and all that it must not have done."""
    gc.collect()  # what the run before has left open complains when it goes
    source, out = place / "ds", place / "out"
    before, here = listing(source), set(listing(Path.cwd()))
    early = interrupted(place, limit_s, fault) if fault.interrupt_s else []
    code, faults, text = command(place, limit_s, fault)
    faults = early + faults
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
            if fault.shown:
                faults += wrong_pictures(dataset, source, fault.shown, whole=fault.whole) + unfit_for_training(dataset)
        except Exception as error:
            faults.append(f"the output cannot be opened: {type(error).__name__} {error}")
    return code, faults, text


def batch(cases: list[tuple[int, str]], options: argparse.Namespace, send: Connection) -> None:
    """Some trials; for each, what was broken is sent before it, and what came of it after it."""
    faulthandler.enable()
    signal.signal(signal.SIGALRM, late)
    signal.signal(signal.SIGPROF, signal.default_int_handler)
    for number, kind in cases:
        fault = case_of(number, kind, options.seed, SCRATCH / "place", options.whole)
        send.send(fault.what + (" (rendered)" if fault.whole else ""))
        send.send(trial(SCRATCH / "place", options.limit, fault))
    shutil.rmtree(SCRATCH / "hf", ignore_errors=True)


def late(*_: Any) -> None:
    """The limit is over."""
    raise TimeoutError("the limit is over")


def trials(
    cases: list[tuple[int, str]], options: argparse.Namespace
) -> Iterator[tuple[int, str, str, int | None, list[str], str]]:
    """Number, kind, what was broken, exit code, faults and text of each trial, whatever it does to its process."""
    while cases:
        receive, send = FORK.Pipe(duplex=False)
        process = FORK.Process(target=batch, args=(cases[:BATCH], options, send))
        process.start()
        send.close()
        for number, kind in cases[:BATCH]:
            broken = "?"
            try:
                if not receive.poll(options.limit + GRACE_S):
                    raise TimeoutError
                broken = receive.recv()
                if not receive.poll(2 * options.limit + GRACE_S):
                    raise TimeoutError
                outcome = receive.recv()
            except (TimeoutError, EOFError) as error:
                process.kill() if isinstance(error, TimeoutError) else None
                process.join()
                outcome = (process.exitcode, ["hangs" if isinstance(error, TimeoutError) else "crashes"], "")
            cases = cases[1:]
            yield number, kind, broken, *outcome
            if process.exitcode is not None:
                break
        process.join()
        receive.close()


def write_originals(kinds: list[str]) -> None:
    """The datasets to break."""
    if RANDOM in kinds:
        write_small_scenes()
    if set(kinds) != {RANDOM}:
        for name, codec, depth in (("marks_h264", "h264", False), ("marks_av1", "av1", False)):
            record(SCRATCH / name, codec, depth=depth)
        record(SCRATCH / "marks_depth", depth=True)


def write_small_scenes() -> None:
    """Pictures as videos, and as images."""
    scenes = [make_scene("push", 0, FRAMES, WIDTH, HEIGHT, episode=index) for index in range(3)]
    for name, dtype in (("video", "video"), ("image", "image")):
        write_dataset(scenes, "local/ds", SCRATCH / name, cameras=["front", "side"], depth=True, image_dtype=dtype)
        (SCRATCH / name / "README.md").write_text("---\nlicense: mit\n---\nA desk.\n")
        for path in (SCRATCH / name / "meta" / "episodes").rglob("*.parquet"):  # read in a tenth of the time without
            table = pq.read_table(path)
            unused = [column for column in table.column_names if column.startswith("stats/")]
            pq.write_table(table.drop_columns(unused), path)


def done_before(results: Path | None, seed: int) -> dict[int, dict[str, Any]]:
    """What an earlier run of a seed has found, by number."""
    if results is None or not results.exists():
        return {}
    rows = [json.loads(line) for line in results.read_text().splitlines()]
    return {row["number"]: row for row in rows if row["seed"] == seed}


def summary(rows: list[dict[str, Any]]) -> str:
    """A line per kind: exit codes and what ended badly."""
    lines = []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == kind]
        codes = dict(sorted(collections.Counter(str(row["code"]) for row in own).items()))
        bad = [row["number"] for row in own if row["faults"]]
        lines.append(f"{kind}: {len(own)} runs, exit codes {codes}; ended badly: {bad or 'none'}")
    return "\n".join(lines)


def main() -> int:
    """Print a summary; 0 if nothing went wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", choices=[RANDOM, *KINDS], default=[RANDOM, *KINDS])
    parser.add_argument("--numbers", type=int, nargs="+")
    parser.add_argument("--limit", type=int, default=120, help="seconds that a run may take")
    parser.add_argument("--results", type=Path, help="a file that is added to")
    parser.add_argument("--whole", type=int, default=5, help="every how manieth run is rendered")
    options = parser.parse_args()
    results = options.results.absolute() if options.results else None
    rows = done_before(results, options.seed)
    cases = [(number, options.kinds[number % len(options.kinds)]) for number in options.numbers or range(options.count)]
    changed = [number for number, kind in cases if number in rows and rows[number]["kind"] != kind]
    if changed:
        parser.error(f"{results} holds run {changed[0]} of this seed with other --kinds")
    work = SCRATCH / "work"
    work.mkdir()
    os.chdir(work)
    writer = FORK.Process(target=write_originals, args=(options.kinds,))
    writer.start()  # this process must not have threads of its own when it is copied
    writer.join()
    begin = time.perf_counter()
    todo = [case for case in cases if options.numbers or case[0] not in rows]
    for done, (number, kind, broken, code, faults, text) in enumerate(trials(todo, options), 1):
        row = {"seed": options.seed, "number": number, "kind": kind, "broken": broken, "code": code, "faults": faults}
        rows[number] = row
        if results is not None:
            with results.open("a") as file:
                file.write(json.dumps(row | {"said": text[-600:]}) + "\n")
        if faults or options.numbers:
            said = "; ".join(faults) or f"exit code {code}"
            print(f"{number} {kind}: {broken}: {said}\n{text[-1500:]}\n", flush=True)
        if done % 100 == 0:
            print(f"{done} runs, {time.perf_counter() - begin:.0f} s", flush=True)
    chosen = [rows[number] for number, _ in cases if number in rows]
    print(summary(chosen))
    os.chdir("/")
    shutil.rmtree(SCRATCH, ignore_errors=True)
    return int(any(row["faults"] for row in chosen))


FORK = multiprocessing.get_context("fork")
REAL = job.augment_episode

if __name__ == "__main__":
    sys.exit(main())
