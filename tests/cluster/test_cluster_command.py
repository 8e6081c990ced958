"""The command: its settings, its plan, and what tasks of it leave when they are killed."""

import contextlib
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.cluster.__main__ import ALIASES, run
from lerobot_msdyn.cluster.config import ClusterConfig, job_settings
from lerobot_msdyn.core.cli import parse_config, run_command
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.dataset.staging import work_folder

FAST = (
    "--repo=local/desk",
    "--new_repo_id=local/new",
    "--cameras=[front]",
    "--variants=1",
    "--gate.enabled=false",
    "--fit.steps=8",
    "--fit.max_width=48",
    "--scene.moving_gaussians=500",
    "--scene.moving_frames=4",
)
SLURM = Path(__file__).parents[2] / "benchmarks" / "slurm_local.sh"


def config(*flags: str) -> ClusterConfig:
    return parse_config(ClusterConfig, ["--repo=local/desk", *flags], ALIASES, command="")


def test_settings_of_the_job_are_those_of_augment() -> None:
    both = ("--seed=3", "--fit.steps=7", "--variants=4")
    assert job_settings(config(*both, "--tasks=64")) == parse_config(
        type(job_settings(config())), ["--repo=local/desk", *both], ALIASES, command=""
    )


def test_a_time_stays_what_was_typed() -> None:
    assert config("--time", "04:30:00").time == "04:30:00"
    assert config("--time=2-00:00:00").time == "2-00:00:00"
    assert config("--time=90").time == "90"


def test_processes_of_a_task() -> None:
    assert config("--cpus_per_task=8").processes == 1  # local: tasks share the machine
    slurm = ("--executor=slurm", "--partition=cpu")
    assert config(*slurm, "--cpus_per_task=8", "--mem_per_cpu_gb=4").processes == 8
    assert config(*slurm, "--cpus_per_task=8", "--mem_per_cpu_gb=1").processes == 2
    assert config(*slurm, "--cpus_per_task=8", "--gpus=1").processes == 1
    assert config(*slurm, "--workers=3").processes == 3


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--executor=kubernetes"], "executor is 'kubernetes'; expected one of local, slurm, ray"),
        (["--executor=slurm"], "partition is empty; expected a partition of SLURM"),
        (["--convert"], "convert is true; expected a source of version v3.0"),
        (["--sbatch==7"], "sbatch has '=7'"),
        (["--tasks=0"], "tasks is 0; expected a value from 1"),
    ],
)
def test_what_cannot_be(flags: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        config(*flags)


def test_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *rest: None if name == "datatrove" else find(name))
    with pytest.raises(ConfigError, match=r"pip install 'lerobot_msdyn\[cluster\]'"):
        run(["--repo=local/desk"])


@pytest.mark.slow
def test_the_plan_has_each_task_and_the_file_for_sbatch(
    desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--executor=slurm", "--partition=cpu", "--time=04:00:00", "--sbatch=[account=lab]", "--tasks=2"]
    assert run([*FAST, f"--root={desk}", f"--new_root={tmp_path / 'new'}", *flags, "--dry_run"]) == 0
    text = capsys.readouterr().out
    assert "3 episodes, 36 frames" in text
    assert [line.split()[:3] for line in text.splitlines() if line.startswith("     ")] == [
        ["0", "1", "12"],
        ["1", "2", "24"],
    ]
    for line in ("#SBATCH --partition=cpu", "#SBATCH --time=04:00:00", "#SBATCH --account=lab", "#SBATCH --array=0-1"):
        assert line in text
    assert f"{tmp_path / 'new_logs'}/episodes_2/slurm_logs/%A_%a.out" in text
    assert list(tmp_path.iterdir()) == []


def _command(desk: Path, out: Path, *flags: str) -> list[str]:
    return [sys.executable, "-m", "lerobot_msdyn.cluster", *FAST, f"--root={desk}", f"--new_root={out}", *flags]


def _files(root: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and path.name != "report.html"
    }


@pytest.fixture(scope="module")
def one(desk: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What one machine writes."""
    out = tmp_path_factory.mktemp("one") / "new"
    assert augment.run([*FAST, f"--root={desk}", f"--new_root={out}", "--workers=1"]) == 0
    return _files(out)


@contextlib.contextmanager
def _a_task_is_killed(out: Path, *words: str) -> Iterator[None]:
    """Meanwhile, the first process of a Python with these words in its command is, once a task works on an episode."""
    ended = threading.Event()

    def kill() -> None:
        while not ended.wait(0.1):
            tasks = []
            if list(work_folder(out).glob("episodes/*/copied.safetensors")):
                for process in Path("/proc").glob("[0-9]*"):
                    with contextlib.suppress(OSError):
                        command = (process / "cmdline").read_bytes().decode().split("\0")
                        if "python" in command[0] and all(any(word in part for part in command) for word in words):
                            tasks.append(int(process.name))
            if tasks:
                os.kill(min(tasks), signal.SIGKILL)  # not what it has started
                return

    killer = threading.Thread(target=kill)
    killer.start()
    yield
    ended.set()
    killer.join()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
@pytest.mark.parametrize("executor", ["local", "ray"])
def test_a_killed_process_costs_its_task_alone(
    desk: Path, one: dict[str, bytes], tmp_path: Path, executor: str
) -> None:
    if executor == "ray":
        pytest.importorskip("ray")
    out = tmp_path / "new"
    command = _command(desk, out, f"--executor={executor}", "--tasks=2", "--at_once=2")
    with _a_task_is_killed(out, "lerobot_msdyn.cluster.rank", f"{out}_logs/job.json"):
        first = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert first.returncode == 2, first.stderr
    assert "killed by SIGKILL" in first.stderr.splitlines()[-1]
    again = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert again.returncode == 0, again.stderr
    assert "3 of 3 episodes" in again.stdout
    assert _files(out) == one
    assert subprocess.run(command, capture_output=True, text=True, timeout=900).stdout.startswith("finished before")


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("sbatch") is None or shutil.which("slurmctld", path=f"{os.environ['PATH']}:/usr/sbin") is None,
    reason="SLURM is not installed (apt-get install slurm-wlm munge)",
)
def test_under_slurm(desk: Path, one: dict[str, bytes], tmp_path: Path) -> None:
    out = tmp_path / "new"
    command = _command(desk, out, "--executor=slurm", "--partition=local", "--tasks=2", "--mem_per_cpu_gb=1")
    wait = 'while [ -n "$(squeue --noheader)" ]; do sleep 1; done'
    said = f'cat "{out}_logs"/merge/errors/*.json'
    with _a_task_is_killed(out, "launch_pickled_pipeline", f"{out}_logs/episodes_2/"):
        done = subprocess.run(
            [str(SLURM), "bash", "-c", f'"$@" && {wait}; {said}; "$@" && {wait}', "command", *command],
            capture_output=True,
            text=True,
            timeout=900,
        )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("submitted: jobs") == 2
    assert "not done" in done.stdout  # what the merge says of the episode whose task was killed
    logs = "\n".join(path.read_text()[-500:] for path in (tmp_path / "new_logs").rglob("*.out"))
    assert out.is_dir(), logs
    assert _files(out) == one


def test_help_names_the_executors(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run_command(run, ["--help"])
    assert "local (this machine), slurm" in capsys.readouterr().out
