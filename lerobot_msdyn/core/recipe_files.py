"""Recipe files: those that come with the package, and how one is found and read. What their fields mean: `config`."""

from pathlib import Path
from typing import Any

import yaml

from lerobot_msdyn.core.errors import ConfigError, one_line


def recipe_folder() -> Path:
    """The folder of the recipes that come with the package (in a checkout: at its top level)."""
    installed = Path(__file__).parents[1] / "recipe_files"
    return installed if installed.is_dir() else Path(__file__).parents[2] / "recipes"


def packaged_recipes() -> list[Path]:
    """The files of the recipes that come with the package; a recipe's name is its file's stem."""
    return sorted(recipe_folder().glob("*.yaml"))


def recipe_path(name: str) -> Path:
    """The file of a recipe, given by that file or by the name of one that comes with the package.

    Raises:
        ConfigError: there is no such recipe.
    """
    path = Path(name)
    if not path.is_file():
        path = recipe_folder() / f"{name}.yaml"
    if not path.is_file():
        names = ", ".join(file.stem for file in packaged_recipes())
        raise ConfigError(f"no recipe {name!r}: neither a file nor one of {names}")
    return path


def read_recipe(name: str) -> dict[str, Any]:
    """The content of a recipe, given by its file or by the name of one that comes with the package.

    Raises:
        ConfigError: there is no such recipe, or it is not a YAML mapping.
    """
    path = recipe_path(name)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"recipe {path} is not readable YAML: {one_line(error)}") from error
    if not isinstance(content, dict | None):
        raise ConfigError(f"recipe {path} holds a {type(content).__name__}; expected a mapping of fields")
    return content or {}
