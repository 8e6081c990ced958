"""The command for recipes: what it lists, shows and refuses."""

import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.recipes import run

PROJECT = Path(__file__).parent.parent
NAMES = ["balanced", "best", "multi_camera", "paper", "quick", "rgbd", "so101_front"]


@pytest.mark.parametrize("name", ["list", "ls"])
def test_list_names_every_recipe_with_its_purpose(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([name]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == NAMES
    assert all(len(line.split()) > 4 for line in lines)


@pytest.mark.parametrize("name", NAMES)
def test_show_is_the_file_and_the_file_opens_with_purpose_command_and_cost(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["show", name]) == 0
    text = capsys.readouterr().out
    assert text == (PROJECT / "recipes" / f"{name}.yaml").read_text()
    head = [line for line in text.splitlines() if line.startswith("#")]
    assert head[1].strip("# ").startswith(f"python -m lerobot_msdyn.augment --repo local/ds --recipe {name}")
    assert head[2].startswith("# Costs")


@pytest.mark.parametrize("name", NAMES)
def test_all_recipes_are_right(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", name]) == 0
    assert capsys.readouterr().out.endswith("all fields and values are right\n")


def test_check_names_every_bad_field_on_one_line_with_exit_code_2(tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("variantz: 2\nfit: {stepz: 3}\n")
    command = [sys.executable, "-m", "lerobot_msdyn.recipes", "check", str(mine)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert "variantz" in done.stderr
    assert "fit.steps" in done.stderr


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("perturbation: {type: orbit, azimuth_deg: -3}", "perturbation.azimuth_deg is -3"),
        ("fit: {steps: many}", r"fit\.steps.*many"),
        ("[1, 2]", "expected a mapping"),
    ],
)
def test_check_names_bad_values(tmp_path: Path, content: str, message: str) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text(content)
    with pytest.raises(ConfigError, match=message):
        run(["check", str(mine)])


@pytest.mark.parametrize("arguments", [["show"], ["show", "a", "b"], ["lost"], ["check"]])
def test_other_words_are_refused(arguments: list[str]) -> None:
    with pytest.raises(ConfigError, match="expected list, show NAME or check FILE"):
        run(arguments)


@pytest.mark.parametrize("action", ["show", "check"])
def test_an_unknown_recipe_is_refused_with_those_that_there_are(action: str) -> None:
    with pytest.raises(ConfigError, match=f"no recipe 'absent'.*{', '.join(NAMES)}"):
        run([action, "absent"])


def test_help_and_no_argument_say_how_it_is_used(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in ([], ["--help"]):
        assert run(arguments) == 0
        assert "show NAME" in capsys.readouterr().out
