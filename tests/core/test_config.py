"""Recipes and flags: what they set, and what is refused."""

import ast
import dataclasses
import importlib
import itertools
import re
import subprocess
import sys
import typing
from pathlib import Path
from typing import Any

import draccus
import pytest
import yaml

from lerobot_msdyn.augment.config import ESSENTIALS, AugmentConfig
from lerobot_msdyn.core.cli import parse_config
from lerobot_msdyn.core.command_help import format_essentials, format_help
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.fields import problems
from lerobot_msdyn.core.recipe_files import read_recipe, recipe_folder
from lerobot_msdyn.views.perturbations.jitter import Jitter
from lerobot_msdyn.views.perturbations.orbit import Orbit

PROJECT = Path(__file__).parents[2]
PACKAGE = PROJECT / "lerobot_msdyn"
RECIPES = sorted((PROJECT / "recipes").rglob("*.yaml"))


def parse(*arguments: str) -> AugmentConfig:
    return parse_config(AugmentConfig, list(arguments), {"repo": "repo_id"}, command="augment")


def test_defaults() -> None:
    assert parse() == AugmentConfig()


def test_flags_override_the_recipe_and_the_recipe_the_defaults(tmp_path: Path) -> None:
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("variants: 5\nfit: {steps: 7, max_width: 64}\n")
    config = parse("--repo", "local/ds", "--recipe", str(recipe), "--fit.steps=9", "--episodes", "[0,3]")
    assert config.repo_id == "local/ds"
    assert config.variants == 5
    assert (config.fit.steps, config.fit.max_width) == (9, 64)
    assert config.fit.weights == AugmentConfig().fit.weights
    assert config.episodes == [0, 3]


def test_order_of_recipe_and_flags_does_not_matter() -> None:
    assert parse("--fit.steps", "9", "--recipe", "quick") == parse("--recipe", "quick", "--fit.steps", "9")


def test_a_switch_needs_no_value() -> None:
    assert parse("--dry_run").dry_run
    assert parse("--dry_run", "--variants", "3").variants == 3
    assert not parse("--dry_run", "false").dry_run


def test_another_perturbation_type_drops_the_fields_of_the_old_one() -> None:
    assert parse("--perturbation.azimuth_deg", "4").perturbation == Orbit(azimuth_deg=4.0)
    assert parse("--perturbation.azimuth_deg", "null").perturbation == Orbit(azimuth_deg=None)
    found = parse("--recipe", "quick", "--perturbation.type", "jitter", "--perturbation.rotation_deg", "2")
    assert found.perturbation == Jitter(rotation_deg=2.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--fit.stepz", "3"], "unknown field 'fit.stepz', did you mean 'fit.steps'"),
        (["--fit.steps", "many"], "fit.steps.*many.*int"),
        (["--fit.steps", "1.5"], "fit.steps.*1.5.*int"),
        (["--fit", "3"], "'fit' is 3; expected a mapping"),
        (["--variants", "0"], "variants is 0; expected a value from 1"),
        (["--camera.horizontal_fov_deg", "500"], "camera.horizontal_fov_deg is 500"),
        (["--motion.levels", "[object,grain]"], r"motion.levels is \[object, grain\]; expected"),
        (["--motion.levels", "[flat,object]"], "motion.levels is"),
        (["--motion.levels", "[objects]"], "motion.levels.*objects"),
        (["--motion.flat_bases", "10"], "motion.flat_bases is a field no more: leave it out, or .*settings.flat.bases"),
        (["--cameras", "{a: b}"], "cameras.*list"),
        (["--repo", "[1]"], r"'repo_id' is \[1\]; expected text"),
        (["--include_source", "maybe"], "include_source.*maybe.*bool"),
        (["--perturbation.type", "shake"], "perturbation.type is 'shake'; expected one of dolly, drift, focal, jitter"),
        (["--perturbation.azimuth_deg", "-3"], "perturbation.azimuth_deg is -3.0; expected a value from 0 to 90"),
        (["--perturbation.elevation_deg", "null"], "'perturbation.elevation_deg' is null; expected a value"),
        (["--perturbation.type", "focal", "--perturbation.zoom", "-1"], "perturbation.zoom is -1.0; expected"),
        (["--perturbation.type", "poses"], "perturbation.poses is empty"),
        (
            ["--perturbation.type", "poses", "--perturbation.poses", "[[1,0,0,0]]"],
            r"perturbation.poses\[0\] is no rigid",
        ),
        (["--perturbation.type", "other_camera"], "perturbation.camera is empty"),
        (["--perturbation.type", "drift", "--perturbation.per_frame"], "perturbation.per_frame is true"),
        (["--fill", "flowers"], "fill.*flowers"),
        (["--max_unseen", "1.5"], "max_unseen is 1.5; expected a value from 0 to 1"),
        (["--fit.weights.rgb", ".inf"], "fit.weights.rgb is inf; expected a value from 0 to 1000000.0"),
        (["--perturbation.rotation_deg", "2"], "unknown field 'perturbation.rotation_deg'"),
        (["--recipe", "absent"], "no recipe 'absent': neither a file nor one of .*quick"),
        (["local/ds"], "unexpected argument 'local/ds'"),
    ],
)
def test_bad_input_is_named(arguments: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        parse(*arguments)
    assert "\n" not in str(caught.value)


def test_all_unknown_fields_are_named_at_once(tmp_path: Path) -> None:
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("variantz: 5\nfit: {stepz: 7}\n")
    with pytest.raises(ConfigError, match=r"mine.yaml.*variantz.*fit\.stepz"):
        parse("--recipe", str(recipe))


@pytest.mark.parametrize("content", ["[1, 2]", "a: [", "!!python/object/apply:os.system ['true']"])
def test_a_recipe_that_is_no_plain_mapping_is_refused(tmp_path: Path, content: str) -> None:
    recipe = tmp_path / "mine.yaml"
    recipe.write_text(content)
    with pytest.raises(ConfigError, match=r"mine\.yaml"):
        read_recipe(str(recipe))


def test_there_are_recipes() -> None:
    assert [path.stem for path in RECIPES] != []
    assert recipe_folder() == PROJECT / "recipes"


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_recipe_is_valid_and_says_how_it_is_used(path: Path) -> None:
    parse("--recipe", str(path))
    text = path.read_text()
    assert f"python -m lerobot_msdyn.augment --repo local/ds --recipe {path.stem}" in text
    assert set(yaml.safe_load(text)) <= {field.name for field in dataclasses.fields(Recipe)}


COMMANDS = {  # what each command line sets
    "augment": "AugmentConfig",
    "evaluate nvs": "EvaluateConfig",
    "evaluate dycheck": "DycheckConfig",
    "evaluate heldout-camera": "HeldoutCameraConfig",
    "priors": "PriorsCommandConfig",
    "split": "SplitConfig",
    "carry": "CarryConfig",
    "viewer": "ViewerConfig",
    "training.plugin": "MixedViewsConfig",
}


def command_configs() -> dict[str, Any]:
    """By name, every dataclass of the package that is called a Config, wherever it stands, and Recipe."""
    classes: dict[str, Any] = {}
    for path in PACKAGE.rglob("*.py"):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and (node.name.endswith("Config") or node.name == "Recipe"):
                module = ".".join(path.relative_to(PROJECT).with_suffix("").parts).removesuffix(".__init__")
                classes[node.name] = getattr(importlib.import_module(module), node.name)
    return {name: kind for name, kind in classes.items() if dataclasses.is_dataclass(kind)}


def with_parts(kind: Any) -> set[type]:
    """A config class, those of its fields, and the choices that these have."""
    classes = {kind}
    for hint in typing.get_type_hints(kind).values():
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            classes |= with_parts(hint)
            if issubclass(hint, draccus.ChoiceRegistry):
                choices: Any = hint
                classes |= {part for choice in choices.get_known_choices().values() for part in with_parts(choice)}
    return classes


CONFIGS = command_configs()
ALL_CLASSES = sorted({part for kind in CONFIGS.values() for part in with_parts(kind)}, key=lambda kind: kind.__name__)


def test_the_configs_of_all_commands_are_looked_at() -> None:
    assert set(COMMANDS.values()) <= set(CONFIGS)
    names = {kind.__name__ for kind in ALL_CLASSES}
    assert {"Recipe", "FitConfig", "MotionConfig", "Orbit", "Drift"} <= names


def test_every_field_is_read_somewhere() -> None:
    code = "\n".join(path.read_text() for path in PACKAGE.rglob("*.py") if path.name not in ("config.py", "cli.py"))
    unread = [
        f"{kind.__name__}.{field.name}"
        for kind in ALL_CLASSES
        for field in dataclasses.fields(kind)
        if not re.search(rf"\.{field.name}\b|\"{field.name}\"", code)
    ]
    assert unread == []


@pytest.mark.parametrize("command", COMMANDS)
def test_every_field_is_explained_in_the_help(command: str) -> None:
    kind = CONFIGS[COMMANDS[command]]
    lines = format_help(kind, {}, command).splitlines()
    explained = {
        line.split()[0]
        for line, following in itertools.pairwise(lines)
        if line.startswith("  --") and following.startswith("      ") and following.strip()
    }
    unexplained = {line.split()[0] for line in lines if line.startswith("  --")} - explained
    assert unexplained == set()
    assert {f"--{field.name}" for field in dataclasses.fields(kind)} <= {
        flag if flag.startswith("--") else f"--{flag.rstrip(':')}"
        for flag in [line.split()[0].split(".")[0] for line in lines if line.strip()]
    }


@pytest.mark.parametrize("kind", ALL_CLASSES, ids=lambda kind: kind.__name__)
def test_every_number_has_a_range_and_a_default_inside_it(kind: Any) -> None:
    hints = typing.get_type_hints(kind)
    numbers = [field for field in dataclasses.fields(kind) if hints[field.name] in (int, float)]
    assert [field.name for field in numbers if "range" not in field.metadata] == []
    needed = [line for line in problems(kind()) if " is empty; expected" in line]  # poses, and another camera's name
    assert problems(kind()) == needed


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("AugmentConfig", ["--workers", "-1"], "workers is -1; expected a value from 0"),
        ("AugmentConfig", ["--seed", "-1"], "seed is -1; expected a value from 0"),
        ("SplitConfig", ["--eval_split", "0"], "eval_split is 0.0; expected a value from 1e-06 to 0.999999"),
        ("SplitConfig", ["--eval_split", "1"], "eval_split is 1.0"),
        ("SplitConfig", ["--eval_split", ".nan"], "eval_split is nan"),
        ("ViewerConfig", ["--episode", "-1"], "episode is -1; expected a value from 0"),
        ("HeldoutCameraConfig", ["--episode", "-1"], "episode is -1"),
        ("AugmentConfig", ["--episodes_share", "0"], "episodes_share is 0.0; expected a value from 0.001 to 1.0"),
        ("MixedViewsConfig", ["--probability", "1.5"], "probability is 1.5; expected a value from 0 to 1"),
        ("PriorsCommandConfig", ["--columns", "0"], "columns is 0"),
    ],
)
def test_a_number_out_of_range_is_refused_by_every_command(name: str, arguments: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_config(CONFIGS[name], arguments, {}, command=name)


def test_help_answers_without_importing_torch() -> None:
    code = (
        "import sys, lerobot_msdyn.augment.__main__ as a\n"
        "for flag in ('--help', '--help-all'):\n"
        "    try: a.run([flag])\n"
        "    except SystemExit: pass\n"
        "assert 'torch' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--fit.steps" in done.stdout


def test_the_short_help_fits_a_screen_and_shows_what_is_typed() -> None:
    lines = format_essentials(AugmentConfig, {"repo": "repo_id"}, "augment", ESSENTIALS).splitlines()
    assert len(lines) <= 25
    assert max(map(len, lines)) <= 120
    shown = {line.split()[0] for line in lines if line.startswith("  --")}
    assert {"--repo", "--episodes", "--cameras", "--dry_run", "--recipe"} <= shown
    assert "--repo_id" not in shown
    assert sum(line.startswith("  augment ") for line in lines) == 3
    assert all(len(line.split()) >= 3 for line in lines if line.startswith("  --"))


@pytest.mark.parametrize("command", COMMANDS)
def test_no_help_shows_what_only_python_knows(command: str) -> None:
    text = format_help(CONFIGS[COMMANDS[command]], {}, command)
    assert "MISSING" not in text
    assert "<dataclasses" not in text
    assert "Short names: ." not in text
    assert ("--recipe" in text) == issubclass(CONFIGS[COMMANDS[command]], Recipe)


@pytest.mark.parametrize(
    ("typed", "expected"),
    [("0", [0]), ("0,3", [0, 3]), ("2-4", [2, 3, 4]), ("0,2-3", [0, 2, 3]), ("[0, 3]", [0, 3]), ("null", None)],
)
def test_episodes_as_people_type_them(typed: str, expected: list[int] | None) -> None:
    assert parse("--episodes", typed).episodes == expected


@pytest.mark.parametrize(("typed", "expected"), [("front", ["front"]), ("front,side", ["front", "side"])])
def test_cameras_as_people_type_them(typed: str, expected: list[str]) -> None:
    assert parse("--cameras", typed).cameras == expected


@pytest.mark.parametrize(
    ("typed", "message"), [("3-1", "'3-1' is no range.*expected 1-3"), ("one", "one"), ("0;3", "0;3"), ("1.5", "1.5")]
)
def test_what_is_no_list_of_episodes_is_refused(typed: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse("--episodes", typed)


def test_flags_with_dashes() -> None:
    config = parse("--dry-run", "--fit.max-width=64", "--new-repo-id", "local/a-b")
    assert (config.dry_run, config.fit.max_width, config.new_repo_id) == (True, 64, "local/a-b")


def test_the_balanced_recipe_holds_the_defaults() -> None:
    assert parse("--recipe", "balanced") == AugmentConfig()


def test_the_help_shows_every_default() -> None:
    text = format_help(AugmentConfig, {}, "augment")
    assert "MISSING" not in text
    assert "--fit.weights dict[str, float] (default: {'rgb': 1.0, 'depth': 0.1, 'mask': 0.1})" in text
