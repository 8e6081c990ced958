"""Several processes make the same dataset as one, and end with the process that started them."""

import filecmp
import json
import logging
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.augment import run, workers
from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.augment.workers import workers_for
from lerobot_msdyn.core import plugins
from lerobot_msdyn.core.cli import EXIT_INTERRUPTED, parse_config
from lerobot_msdyn.core.errors import OutputError
from lerobot_msdyn.core.perturbation import PERTURBATIONS
from lerobot_msdyn.core.registries import DEPTH
from lerobot_msdyn.dataset.read import open_source
from lerobot_msdyn.dataset.write import OutputDataset

pytestmark = pytest.mark.slow

FAST = (
    "--fit.steps",
    "8",
    "--scene.moving_gaussians",
    "500",
    "--scene.moving_frames",
    "4",
    "--variants",
    "1",
    "--gate.enabled",
    "false",
)


def command(desk: Path, out: Path, *more: str) -> list[str]:
    return ["--repo", "local/desk", "--root", str(desk), "--new_root", str(out), "--cameras", "[front]", *FAST, *more]


def files(root: Path) -> list[Path]:
    """All files of a dataset but the report, which tells the time."""
    return sorted(path.relative_to(root) for path in root.rglob("*") if path.is_file() and path.name != "report.html")


def workers_writing_to(log: Path) -> list[int]:
    """Started processes whose standard output is that of the run."""
    workers = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if (process / "fd" / "1").readlink() == log and b"spawn_main" in (process / "cmdline").read_bytes():
                workers.append(int(process.name))
        except OSError:
            continue
    return workers


def test_how_many() -> None:
    assert workers_for(AugmentConfig(workers=3), 10, 5) == 3
    assert workers_for(AugmentConfig(workers=3), 10, 2) == 2
    assert workers_for(AugmentConfig(), 10, 5) == 1  # too little work to start one for
    assert workers_for(AugmentConfig(), 100_000, 500) >= 1


def test_two_workers_make_the_same_dataset(desk: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        for count in (1, 2):
            assert (
                augment.run(command(desk, tmp_path / str(count), "--workers", str(count), "--priors.cache", "off")) == 0
            )
    one, two = files(tmp_path / "1"), files(tmp_path / "2")
    assert one == two
    _, different, failed = filecmp.cmpfiles(tmp_path / "1", tmp_path / "2", one, shallow=False)
    assert (different, failed) == ([], [])
    assert not any(record.getMessage().startswith("overlay:") for record in caplog.records)  # a stage's finding
    assert any(record.getMessage().startswith("episode 0, ") for record in caplog.records)  # said by a worker


PLUGIN = """
import torch
from lerobot_msdyn.core.observations import DepthTraits
from lerobot_msdyn.priors.registry import DEPTH, Depth, DepthProvider, Estimate

@DEPTH.register("far_wall")
class FarWall(DepthProvider):
    reads_recorded_depth = False

    def estimate(self, request, instances):
        return Estimate(Depth(torch.full(instances.shape, METRES), DepthTraits(sharp=True)))
"""


@pytest.fixture
def plugin(tmp_path: Path) -> Iterator[Path]:
    """A provider of a user's own, or what a test writes there, in a file named like one of Python's modules."""
    path = tmp_path / "random.py"
    path.write_text(PLUGIN.replace("METRES", "1.5"))
    yield path
    DEPTH._registered.pop("far_wall", None)
    PERTURBATIONS._registered.pop("shove", None)
    plugins._imported.pop(str(path), None)


def forgotten(plugin: Path) -> None:
    """The plugin is imported anew, as by another run."""
    DEPTH._registered.pop("far_wall")
    plugins._imported.pop(str(plugin))


def test_workers_use_a_plugin_of_the_run(
    desk: Path, tmp_path: Path, plugin: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    flags = ("--plugins", str(plugin), "--priors.depth", "far_wall", "--workers", "2", "--episodes", "[0,1]")
    assert augment.run(command(desk, tmp_path / "new", *flags)) == 0
    assert "rendered by motion" in caplog.text  # as workers say
    assert "video codec" not in caplog.text  # as LeRobot says in them
    rows = pq.read_table(tmp_path / "new" / "meta" / "msdyn" / "episodes.parquet").to_pylist()
    made = [json.loads(row["priors"]) for row in rows if row["variant"] >= 0]
    assert [priors["observation.images.front"]["depth"]["provider"] for priors in made] == ["far_wall"] * 2


def test_settings_reach_a_worker_as_plain_values(desk: Path, tmp_path: Path, plugin: Path) -> None:
    """They may be of a plugin's types, which cannot be read before the plugin is imported."""
    plugin.write_text(
        "from dataclasses import dataclass\nfrom lerobot_msdyn.core.perturbation import Perturbation\n"
        "@Perturbation.register_subclass('shove')\n@dataclass\nclass Shove(Perturbation):\n"
        "    metres: float = 0.5\n"
    )
    flags = command(desk, tmp_path / "new", "--plugins", str(plugin), "--perturbation.type", "shove")
    config = parse_config(AugmentConfig, [*flags, "--perturbation.metres", "2"], augment.ALIASES, command="")
    source = open_source("local/desk", desk)
    work = workers.Work(
        source, frozenset({0}), ["front"], config, OutputDataset(source, "local/new", tmp_path / "new"), lambda *_: None
    )
    sent = pickle.dumps(workers._place_of(work))
    assert plugins.PREFIX.encode() not in sent
    assert workers._config_at(pickle.loads(sent)) == config


def test_a_run_goes_on_only_with_the_plugin_that_it_began_with(
    desk: Path, tmp_path: Path, plugin: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run.augment_episode

    def stopped(source: Any, index: int, *rest: Any) -> object:
        if index == 1:
            raise KeyboardInterrupt
        return whole(source, index, *rest)

    monkeypatch.setattr(run, "augment_episode", stopped)
    flags = ("--plugins", str(plugin), "--priors.depth", "far_wall", "--workers", "1", "--episodes", "[0,1]")
    arguments = command(desk, tmp_path / "new", *flags)
    assert augment.run(arguments) == EXIT_INTERRUPTED
    forgotten(plugin)
    assert augment.run(arguments) == EXIT_INTERRUPTED
    forgotten(plugin)
    plugin.write_text(PLUGIN.replace("METRES", "2.25"))
    with pytest.raises(OutputError, match=r"started differently: plugins: .*random\.py has changed"):
        augment.run(arguments)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
@pytest.mark.parametrize("killed", ["parent", "worker"])
def test_all_processes_end_where_one_is_killed(desk: Path, tmp_path: Path, killed: str) -> None:
    out, log = tmp_path / "new", tmp_path / "log"
    flags = command(desk, out, "--workers", "2", "--fit.steps", "5000", "--scene.shared_background", "false")
    with log.open("w") as stream:
        started = [sys.executable, "-m", "lerobot_msdyn.augment", *flags]
        run = subprocess.Popen(started, stdout=stream, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 300
    while len(list((tmp_path / ".new.partial" / "episodes").glob("*/copied.safetensors"))) < 2:
        assert time.monotonic() < deadline
        assert run.poll() is None
        time.sleep(0.1)
    os.kill(run.pid if killed == "parent" else workers_writing_to(log)[0], signal.SIGKILL)
    errors = run.communicate(timeout=60)[1].splitlines()
    if killed == "parent":
        assert run.returncode == -signal.SIGKILL
    else:
        assert run.returncode == 2
        assert "error: one of 2 worker processes ended unexpectedly" in errors[-1]
    while workers_writing_to(log):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert not out.exists()
