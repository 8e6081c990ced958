"""The README's commands do what it says, as they stand there."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from tiny_act import SMALL_ACT

from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset

PROJECT = Path(__file__).parent.parent
IN_CI = {"make demo", "make test"}  # .ci/run
BY_THE_WHEEL_TEST = {"pip install '.[priors]'"}


def commands() -> list[str]:
    blocks = re.findall(r"```sh\n(.*?)```", (PROJECT / "README.md").read_text(), re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line.strip()]


def test_every_command_is_run_somewhere() -> None:
    ci = (PROJECT / ".ci" / "run").read_text().splitlines()
    assert set(ci) >= IN_CI
    assert set(commands()) - IN_CI - BY_THE_WHEEL_TEST == {*augment_commands(), train_command()}


def augment_commands() -> list[str]:
    return [command for command in commands() if "lerobot_msdyn.augment" in command]


def train_command() -> str:
    return next(command for command in commands() if command.startswith("lerobot-train"))


def run(command: list[str], home: Path) -> str:
    program = Path(sys.executable)
    command[0] = str(program if command[0] == "python" else program.with_name(command[0]))
    environment = os.environ | {"HF_LEROBOT_HOME": str(home), "HF_HUB_OFFLINE": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=400, env=environment, cwd=home)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout + done.stderr


@pytest.mark.slow
def test_augment_and_train(tmp_path: Path) -> None:
    augment = augment_commands()[0]
    assert "2 new ones" in augmented(augment, tmp_path)
    assert (tmp_path / "local" / "ds_msdyn" / "meta" / "info.json").is_file()
    printed = run([*shlex.split(train_command()), f"--output_dir={tmp_path / 'run'}", *SMALL_ACT], tmp_path)
    assert "dataset.num_episodes=3" in printed
    assert "End of training" in printed


@pytest.mark.slow
@pytest.mark.parametrize("command", augment_commands()[1:])
def test_the_other_ways_to_augment(command: str, tmp_path: Path) -> None:
    assert "1 of 1 episodes, 2 new ones" in augmented(command, tmp_path)


def augmented(command: str, home: Path) -> str:
    """What the command says of a dataset of the name that it takes."""
    write_dataset([make_scene("push", 0, 10, 64, 48)], "local/ds", home / "local" / "ds")
    return run(shlex.split(command), home)
