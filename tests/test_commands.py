"""The command that has all others, and the export of kept scenes."""

import importlib
from pathlib import Path

import pytest

from lerobot_msdyn.__main__ import COMMANDS, run
from lerobot_msdyn.core.errors import ConfigError, MsdynError, OutputError
from lerobot_msdyn.scene.ply import load_ply


def test_every_command_is_there_and_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run([]) == 0
    listed = capsys.readouterr().out
    for name, (module, purpose) in COMMANDS.items():
        assert callable(importlib.import_module(f"lerobot_msdyn.{module}").run)
        assert name in listed
        assert purpose in listed


def test_a_command_gets_its_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["recipes", "list"]) == 0
    assert "balanced" in capsys.readouterr().out


@pytest.mark.parametrize(("typed", "hint"), [("agument", "did you mean augment"), ("x", "expected one of augment")])
def test_a_mistyped_command_is_answered_with_the_nearest(typed: str, hint: str) -> None:
    with pytest.raises(ConfigError, match=f"no command '{typed}'; {hint}"):
        run([typed])


def test_frames_of_a_kept_scene_as_ply(desk_scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["export-ply", f"--scenes={desk_scenes}", "--episode=1", "--frames=0,2-3", f"--out={tmp_path}"]) == 0
    paths = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert [path.name for path in paths] == ["frame_000000.ply", "frame_000002.ply", "frame_000003.ply"]
    assert all(len(load_ply(path)) > 100 for path in paths)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "which scenes"),
        (["--scenes={scenes}", "--episode=7"], "no scene of episode 7; there are those of 0, 1"),
        (["--scenes={scenes}", "--camera=side"], "no scene of camera 'side'; there are observation.images.front"),
        (["--scenes={scenes}", "--frames=99999"], "no frame 99999; episode 0 has 0 to "),
        (["--scenes={tmp}"], "no saved scenes"),
        (["--scenes={scenes}", "--out={scenes}/meta/info.json"], "cannot be written"),
    ],
)
def test_bad_input_of_the_export(flags: list[str], message: str, desk_scenes: Path, tmp_path: Path) -> None:
    with pytest.raises((ConfigError, MsdynError, OutputError), match=message):
        run(["export-ply", *(flag.format(scenes=desk_scenes, tmp=tmp_path) for flag in flags)])
