"""Episodes at the same time: the same results, stopped together, and a full GPU costs its episode only."""

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from lerobot_msdyn import augment, engines
from lerobot_msdyn.errors import EpisodeError, OutputError


def bar() -> engines._Bar:
    shown: Any = SimpleNamespace(n=0.0, set_description_str=lambda what: None)
    shown.update = lambda share: setattr(shown, "n", shown.n + share)
    return engines._Bar(shown, 3)


def test_episodes_at_the_same_time_give_the_same_files(desk: Path, tmp_path: Path) -> None:
    flags = {"repo": "local/desk", "root": desk, "episodes": "[0,1]", "cameras": "[front]", "variants": 1}
    flags |= {"fit.steps": 8, "scene.moving_gaussians": 300, "scene.moving_frames": 4, "gate.enabled": "false"}
    for at_once in (1, 2):
        own = {"new_root": tmp_path / str(at_once), "episodes_at_once": at_once, "new_repo_id": "local/new"}
        assert augment.run([f"--{name}={value}" for name, value in (flags | own).items()]) == 0
    videos = [sorted((tmp_path / name).rglob("*.mp4")) for name in "12"]
    assert len(videos[0]) == len(videos[1]) > 0
    assert [path.read_bytes() for path in videos[0]] == [path.read_bytes() for path in videos[1]]


def test_results_are_in_order_and_threads_are_shared() -> None:
    together = threading.Barrier(2, timeout=30)

    def work(index: int) -> tuple[int, int]:
        together.wait()
        return index, torch.get_num_threads()

    threads = max(1, torch.get_num_threads() // 2)
    assert engines._in_threads(work, [3, 1], 2, bar()) == [(3, threads), (1, threads)]


def test_a_fault_that_concerns_all_stops_the_others() -> None:
    progress, started = bar(), threading.Event()
    stopped = []

    def work(index: int) -> None:
        if index == 0:
            started.wait(30)
            raise OutputError("the disk is full")
        started.set()
        try:
            while True:
                progress.add("", 0.0)
        except KeyboardInterrupt:
            stopped.append(index)
            raise

    with pytest.raises(OutputError, match="the disk is full"):
        engines._in_threads(work, [0, 1, 2], 2, progress)
    assert stopped == [1]


def test_a_full_gpu_costs_its_episode() -> None:
    def fail() -> list:
        raise torch.OutOfMemoryError("CUDA out of memory")

    found = engines._attempt("local/desk episode 3", fail)
    assert isinstance(found, EpisodeError)
    assert str(found).startswith("local/desk episode 3: the memory of the GPU is full; lower --episodes_at_once")


def test_shares_add_up() -> None:
    progress = bar()
    for _ in range(3):
        share = engines._Share(progress)
        share.add("fitting", 0.3)
        share.finish()
    assert progress._shown.n == pytest.approx(3)
