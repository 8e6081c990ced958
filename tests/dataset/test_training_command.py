"""The command that the job prints at its end: it trains, as it stands."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from lerobot.datasets import LeRobotDatasetMetadata
from tiny_act import SMALL_ACT

from lerobot_msdyn.dataset.training_command import training_command

FRONT, SIDE = "observation.images.front", "observation.images.side"


def test_policies_get_colours_and_state_where_depth_is_recorded(desk: Path) -> None:
    meta = LeRobotDatasetMetadata("local/desk", desk)
    command = shlex.split(training_command(meta, 1, "local/new", Path("/a folder/new")))
    flags = dict(word.removeprefix("--").split("=", 1) for word in command[1:])
    assert flags["dataset.root"] == "/a folder/new"
    features = json.loads(flags["policy.input_features"])
    assert set(features) == {FRONT, SIDE, "observation.state"}
    assert features[FRONT] == {"type": "VISUAL", "shape": [3, 48, 64]}


def test_whole_recordings_are_held_out_where_there_are_several(desk: Path) -> None:
    meta = LeRobotDatasetMetadata("local/desk", desk)
    assert "$(python -m lerobot_msdyn.split --root '/a folder')" in training_command(meta, 2, "n", Path("/a folder"))
    assert "split" not in training_command(meta, 1, "n", Path("/a folder"))


@pytest.mark.slow
def test_the_command_trains_as_it_stands(desk: Path, tmp_path: Path) -> None:
    command = training_command(LeRobotDatasetMetadata("local/desk", desk), 3, "local/desk", desk)
    small = shlex.join([*SMALL_ACT, f"--output_dir={tmp_path / 'run'}"])
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", f"{command} {small}"],
        env=os.environ | {"PATH": programs},
        capture_output=True,
        text=True,
        check=False,
        timeout=500,
    )
    assert done.returncode == 0, done.stderr[-3000:]
