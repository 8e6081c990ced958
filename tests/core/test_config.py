"""Recipes and flags: what they set, and what is refused."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.core import config as config_module
from lerobot_msdyn.core.cli import format_help, parse_config
from lerobot_msdyn.core.config import JitterConfig, OrbitConfig, Recipe
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.recipe_files import read_recipe, recipe_folder

PROJECT = Path(__file__).parents[2]
RECIPES = sorted((PROJECT / "recipes").rglob("*.yaml"))


def parse(*arguments: str) -> AugmentConfig:
    return parse_config(AugmentConfig, list(arguments), {"repo": "repo_id"}, command="augment")


def test_defaults() -> None:
    assert parse() == AugmentConfig()


def test_flags_override_the_recipe_and_the_recipe_the_defaults(tmp_path: Path) -> None:
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("variants: 5\nfit: {steps: 7, max_width: 64}\n")
    found = parse("--repo", "local/ds", "--recipe", str(recipe), "--fit.steps=9", "--episodes", "[0,3]")
    assert found.repo_id == "local/ds"
    assert found.variants == 5
    assert (found.fit.steps, found.fit.max_width) == (9, 64)
    assert found.fit.weights == AugmentConfig().fit.weights
    assert found.episodes == [0, 3]


def test_order_of_recipe_and_flags_does_not_matter() -> None:
    assert parse("--fit.steps", "9", "--recipe", "quick") == parse("--recipe", "quick", "--fit.steps", "9")


def test_a_switch_needs_no_value() -> None:
    assert parse("--dry_run").dry_run
    assert parse("--dry_run", "--variants", "3").variants == 3
    assert not parse("--dry_run", "false").dry_run


def test_another_perturbation_type_drops_the_fields_of_the_old_one() -> None:
    assert parse("--perturbation.azimuth_deg", "4").perturbation == OrbitConfig(azimuth_deg=4.0)
    found = parse("--recipe", "quick", "--perturbation.type", "jitter", "--perturbation.rotation_deg", "2")
    assert found.perturbation == JitterConfig(rotation_deg=2.0)


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
        (["--cameras", "front"], "cameras.*front.*list"),
        (["--repo", "[1]"], r"'repo_id' is \[1\]; expected text"),
        (["--include_source", "maybe"], "include_source.*maybe.*bool"),
        (["--perturbation.type", "shake"], "perturbation.type is 'shake'; expected one of dolly, drift, focal, jitter"),
        (["--perturbation.azimuth_deg", "-3"], "perturbation.azimuth_deg is -3.0; expected a value from 0 to 90"),
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


def config_classes() -> list[type]:
    return [
        item
        for item in vars(config_module).values()
        if dataclasses.is_dataclass(item) and isinstance(item, type) and item.__module__ == config_module.__name__
    ]


def test_every_field_is_read_somewhere() -> None:
    code = "\n".join(
        path.read_text()
        for path in (PROJECT / "lerobot_msdyn").rglob("*.py")
        if path.name not in ("config.py", "cli.py")
    )
    unread = [
        f"{kind.__name__}.{field.name}"
        for kind in config_classes()
        for field in dataclasses.fields(kind)
        if not re.search(rf"\.{field.name}\b|\"{field.name}\"", code)
    ]
    assert unread == []


def test_every_field_is_explained_in_the_help() -> None:
    text = format_help(AugmentConfig, {"repo": "repo_id"}, "augment")
    for line, following in zip(text.splitlines(), text.splitlines()[1:], strict=False):
        if line.startswith("  --"):
            assert following.strip(), line


def test_help_answers_without_importing_torch() -> None:
    code = (
        "import sys, lerobot_msdyn.augment.__main__ as a\n"
        "try: a.run(['--help'])\n"
        "except SystemExit: pass\n"
        "assert 'torch' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--fit.steps" in done.stdout


def test_the_balanced_recipe_holds_the_defaults() -> None:
    assert parse("--recipe", "balanced") == AugmentConfig()
