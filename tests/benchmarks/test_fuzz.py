"""The fuzzer's own instruments: marks that can be read, and a judge that sees a wrong picture."""

import importlib
import json
import random
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def tools(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The modules beside the benchmark."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    return SimpleNamespace(**{name: importlib.import_module(name) for name in ("marks", "faults", "judge")})


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with marks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        root: Path = tmp_path_factory.mktemp("marks") / "ds"
        importlib.import_module("faults").record(root)
    return root


def test_marks_are_read_wherever_they_are(tools: SimpleNamespace) -> None:
    marks = [(camera, episode, frame) for camera in range(2) for episode in range(4) for frame in range(12)]
    noise = np.random.default_rng(0).normal(0, 12, (48, 64, 3))
    for mark in marks:
        image = tools.marks.picture(mark)
        assert tools.marks.read_mark(image) == mark
        assert tools.marks.read_mark((image * 0.5 + noise).clip(0, 255)) == mark
    for shift in ((8, 6), (-8, -6), (6, 0), (0, 5)):
        assert tools.marks.read_mark(tools.marks.picture((1, 2, 5), shift)) == (1, 2, 5)
    assert tools.marks.read_turned(np.rot90(tools.marks.picture((0, 3, 7)))) == ((0, 3, 7), 3)
    assert tools.marks.read_mark(np.full((48, 64, 3), 90)) is None
    assert tools.marks.read_mark(tools.marks.picture((0, 1, 2))[::-1]) is None


def opened(root: Path) -> LeRobotDataset:
    """A dataset as if it were an output that holds copies only."""
    (root / "meta" / "msdyn").mkdir(exist_ok=True)
    dataset = LeRobotDataset("local/ds", root=root, video_backend="pyav")
    variants = pa.table({"variant": [-1] * dataset.num_episodes})
    pq.write_table(variants, root / "meta" / "msdyn" / "episodes.parquet")
    return dataset


def judged(tools: SimpleNamespace, root: Path, source: Path, shown: object = None) -> list[str]:
    """What the judge finds in copies of a source."""
    dataset = opened(root)
    found = tools.judge.wrong_pictures(dataset, source, shown or tools.faults.as_recorded(), whole=False)
    return [line.partition(":")[0] for line in found + tools.judge.unfit_for_training(dataset)]


def test_the_judge_sees_what_is_wrong(tools: SimpleNamespace, recorded: Path, tmp_path: Path) -> None:
    root, faults = tmp_path / "ds", tools.faults
    shutil.copytree(recorded, root)
    assert judged(tools, root, recorded) == []
    late = faults.drawn(0, 1)
    faults.lay_out(root, 0, [[0, 1, 2, 3]], [faults.Encoding()], {1: [late[0], *late[:-1]]})
    assert judged(tools, root, recorded) == [f"{faults.LENGTHS[1] - 1} x wrong picture"]
    faults.lay_out(root, 0, [[0, 1, 2, 3]], [faults.Encoding()], {1: [image[:, ::-1] for image in late]})
    assert judged(tools, root, recorded) == [f"{faults.LENGTHS[1]} x unreadable picture"]
    faults.lay_out(root, 0, [[0, 1, 2, 3]], [faults.Encoding()], {1: [np.rot90(image, 2) for image in late]})
    assert judged(tools, root, recorded) == [f"{faults.LENGTHS[1]} x turned picture"]
    faults.lay_out(root, 0, [[0, 1, 2, 3]], [faults.Encoding()])
    stats = json.loads((root / "meta" / "stats.json").read_text())
    stats.pop(faults.KEYS[1])
    (root / "meta" / "stats.json").write_text(json.dumps(stats))
    assert judged(tools, root, recorded) == [f"a trainer lacks the statistics of ['{faults.KEYS[1]}']"]


def test_every_kind_changes_a_dataset(tools: SimpleNamespace, recorded: Path, tmp_path: Path) -> None:
    for name, kind in tools.faults.KINDS.items():
        for seed in range(3):
            root = tmp_path / f"{name}_{seed}"
            shutil.copytree(recorded, root)
            fault = kind(root, random.Random(seed))
            assert fault.what
            assert {len(rows) for (_, episode), rows in fault.shown.items() if episode == 1} == {
                tools.faults.LENGTHS[1]
            }
            before, after = (
                {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
                for folder in (recorded, root)
            )
            assert (before == after) == (name in ("intact", "interrupted"))
            shutil.rmtree(root)
