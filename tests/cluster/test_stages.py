"""The steps of the job, in one process: any number of tasks, killed and repeated ones, make what one machine makes."""

import filecmp
import random
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import made_up_views
import pytest

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.augment import run as episodes_of
from lerobot_msdyn.cluster import stages
from lerobot_msdyn.cluster.__main__ import ALIASES
from lerobot_msdyn.cluster.config import ClusterConfig
from lerobot_msdyn.cluster.plan import job_of, unfinished_ranks
from lerobot_msdyn.cluster.task import RESULT, Job, read_json
from lerobot_msdyn.core.cli import parse_config
from lerobot_msdyn.core.errors import OutputError, WorkerError
from lerobot_msdyn.dataset.staging import work_folder
from lerobot_msdyn.dataset.write import OutputDataset

QUICK = ("--repo=local/desk", "--new_repo_id=local/new", "--cameras=[front]", "--variants=1", "--gate.enabled=false")
ALONE = "--scene.shared_background=false"


@pytest.fixture(autouse=True)
def _made_up(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(episodes_of, "augment_episode", made_up_views.made_up)
    yield
    made_up_views.UNREADABLE.clear()


@pytest.fixture(scope="module")
def one(desk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What one machine writes."""
    out = tmp_path_factory.mktemp("one") / "new"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(episodes_of, "augment_episode", made_up_views.made_up)
        assert augment.run([*QUICK, ALONE, f"--root={desk}", f"--new_root={out}", "--workers=1"]) == 0
    return out


def job(desk: Path, out: Path, *more: str) -> Job:
    flags = [*QUICK, ALONE, f"--root={desk}", f"--new_root={out}", *more]
    described = job_of(parse_config(ClusterConfig, flags, ALIASES, command=""))
    described.write()
    return described


def work_on(job: Job, ranks: list[int]) -> None:
    for rank in ranks:
        assert all(done.failure == "" for done in stages.episodes(job, rank, job.tasks))


def assert_same(one: Path, other: Path) -> None:
    """All files but the report, which tells the time, are the same."""

    def files(root: Path) -> list[str]:
        paths = (path for path in root.rglob("*") if path.is_file() and path.name != "report.html")
        return sorted(str(path.relative_to(root)) for path in paths)

    assert files(one) == files(other)
    _, different, unread = filecmp.cmpfiles(one, other, files(one), shallow=False)
    assert (different, unread) == ([], [])
    assert (other / "report.html").is_file()


@pytest.mark.parametrize("tasks", [1, 2, 3, 7])
def test_any_number_of_tasks_makes_the_same(desk: Path, one: Path, tmp_path: Path, tasks: int) -> None:
    made = job(desk, tmp_path / "new", f"--tasks={tasks}")
    stages.background(made)
    ranks = list(range(tasks))
    random.Random(tasks).shuffle(ranks)
    work_on(made, ranks)
    stages.merge(made)
    assert_same(one, tmp_path / "new")
    stages.merge(made)
    assert_same(one, tmp_path / "new")
    assert not work_folder(tmp_path / "new").exists()
    assert "3 of 3 episodes" in read_json(f"{made.logs}/{RESULT}")["text"]


@pytest.mark.parametrize("include", ["true", "false"])
def test_tasks_choose_the_episodes_that_one_machine_chooses(desk: Path, tmp_path: Path, include: str) -> None:
    some = ("--episodes_share=0.6", f"--include_source={include}")
    flags = [*QUICK, ALONE, *some, f"--root={desk}", f"--new_root={tmp_path / 'one'}", "--workers=1"]
    assert augment.run(flags) == 0
    made = job(desk, tmp_path / "new", "--tasks=2", *some)
    stages.background(made)
    assert unfinished_ranks(made) == [0, 1]
    work_on(made, [0, 1])
    assert unfinished_ranks(made) == []
    stages.merge(made)
    assert_same(tmp_path / "one", tmp_path / "new")


def test_a_killed_task_goes_on_where_it_was(
    desk: Path, one: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = job(desk, tmp_path / "new", "--tasks=2")
    stages.background(made)
    stage = OutputDataset.stage
    staged: list[int] = []

    def killed(self: OutputDataset, index: int, *rest: Any) -> object:
        staged.append(index)
        if index == 1 and staged.count(1) == 1:
            raise KeyboardInterrupt
        return stage(self, index, *rest)

    monkeypatch.setattr(OutputDataset, "stage", killed)
    with pytest.raises(KeyboardInterrupt):
        work_on(made, [0, 1])
    assert 1 in staged
    with pytest.raises(WorkerError, match=r"2 episodes are not done \(1 to 2\): task 1: out of memory"):
        stages.merge(made, {1: "out of memory"})
    assert unfinished_ranks(made) == [1]
    work_on(made, [0, 1])
    assert staged == [0, 1, 1, 2]
    assert unfinished_ranks(made) == []
    stages.merge(made)
    assert_same(one, tmp_path / "new")


def test_failed_episodes_are_named_and_tried_again(desk: Path, one: Path, tmp_path: Path) -> None:
    made = job(desk, tmp_path / "new", "--tasks=2")
    stages.background(made)
    made_up_views.UNREADABLE.add(1)
    for rank in range(2):
        failures = [done.failure for done in stages.episodes(made, rank, 2) if done.failure]
        assert failures in ([], ["local/desk episode 1: cannot be read"])
    stages.merge(made)
    assert read_json(f"{made.logs}/{RESULT}")["left_out"] == ["skipped: local/desk episode 1: cannot be read"]
    before = (tmp_path / "new" / "meta" / "info.json").read_text()
    stages.merge(made)  # nothing new
    assert (tmp_path / "new" / "meta" / "info.json").read_text() == before
    assert len(unfinished_ranks(made)) == 1
    made_up_views.UNREADABLE.clear()
    stages.background(made)
    work_on(made, unfinished_ranks(made))
    stages.merge(made)
    assert_same(one, tmp_path / "new")
    assert not work_folder(tmp_path / "new").exists()


@pytest.fixture(params=["memory", "s3"])
def bucket(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """URL of an empty bucket: in memory, and on an S3 server (PyPI's moto[server] and s3fs) where that is installed."""
    if request.param == "memory":
        yield "memory://bucket"
        fsspec.filesystem("memory").rm("/bucket", recursive=True)
        return
    pytest.importorskip("s3fs")
    server = pytest.importorskip("moto.server").ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setattr(
        "fsspec.config.conf", {"s3": {"endpoint_url": f"http://{host}:{port}", "key": "-", "secret": "-"}}
    )
    fsspec.filesystem("s3").mkdir("bucket")
    yield "s3://bucket"
    server.stop()


def test_through_an_object_store(
    desk: Path, one: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bucket: str
) -> None:
    """Nodes have nothing in common but the store: each step begins with an empty disk."""
    made = job(desk, tmp_path / "new", "--tasks=3", f"--store={bucket}/job")

    def on_a_node(name: str) -> None:
        (tmp_path / name).mkdir()
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path / name))

    on_a_node("first")
    stages.background(made)
    for rank in (2, 0, 1, 0):
        on_a_node(f"node{rank}_{len(list(tmp_path.iterdir()))}")
        work_on(made, [rank])
    assert unfinished_ranks(made) == []
    on_a_node("last")
    stages.merge(made)
    files, root = fsspec.url_to_fs(f"{bucket}/job")
    files.invalidate_cache()
    files.get(f"{root}/dataset", str(tmp_path / "got"), recursive=True)
    assert_same(one, tmp_path / "got")
    assert not files.exists(f"{root}/episodes")
    assert not (tmp_path / "new").exists()


def test_a_node_that_would_make_something_else_is_refused(
    desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = job(desk, tmp_path / "new")
    with pytest.raises(WorkerError, match="the step background is not done"):
        work_on(made, [0])
    stages.background(made)
    monkeypatch.setattr(stages, "what_is_here", lambda: {"models": ["raft"], "libraries": []})
    with pytest.raises(WorkerError, match=r"would make something else .*models was .*, is \['raft'\]"):
        work_on(made, [0])
    monkeypatch.undo()
    other = job(desk, tmp_path / "new", "--seed=5")
    with pytest.raises(WorkerError, match=r"would make something else .*seed was 0, is 5"):
        work_on(other, [0])
    with pytest.raises(OutputError, match="was started differently: seed was 0, is 5"):
        stages.background(other)


def test_what_lies_in_the_place_of_the_output_is_left(desk: Path, tmp_path: Path) -> None:
    made = job(desk, tmp_path / "new", "--tasks=1")
    stages.background(made)
    work_on(made, [0])
    shutil.copytree(desk, tmp_path / "new")
    with pytest.raises(OutputError, match="exists already"):
        stages.merge(made)
