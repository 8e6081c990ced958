"""Several processes make the same dataset as one, and end with the process that started them."""

import filecmp
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.augment.workers import workers_for

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
    assert any(record.getMessage().startswith("overlay:") for record in caplog.records)  # said by a worker


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
@pytest.mark.parametrize("killed", ["parent", "worker"])
def test_all_processes_end_where_one_is_killed(desk: Path, tmp_path: Path, killed: str) -> None:
    out, log = tmp_path / "new", tmp_path / "log"
    flags = command(desk, out, "--workers", "2", "--fit.steps", "5000")
    with log.open("w") as stream:
        started = [sys.executable, "-m", "lerobot_msdyn.augment", *flags]
        run = subprocess.Popen(started, stdout=stream, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
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
