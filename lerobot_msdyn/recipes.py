"""Command line: the recipes that come with the package, and whether one of your own is right.

python -m lerobot_msdyn.recipes list | show NAME | check FILE
"""

import sys
from pathlib import Path

from lerobot_msdyn.core.cli import EXIT_OK, load_recipe, run_command
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.recipe_files import packaged_recipes, recipe_path

USAGE = """usage: python -m lerobot_msdyn.recipes list         name and purpose of every recipe
       python -m lerobot_msdyn.recipes show NAME    one recipe, to copy and change
       python -m lerobot_msdyn.recipes check FILE   whether a recipe's fields and values are right
"""


def run(arguments: list[str]) -> int:
    """Run one of the three; returns the exit code."""
    if arguments[:1] in ([], ["-h"], ["--help"]):
        sys.stdout.write(USAGE)
        return EXIT_OK
    match arguments:
        case ["list" | "ls"]:
            sys.stdout.write("".join(f"{path.stem:14s}{purpose(path)}\n" for path in packaged_recipes()))
        case ["show", name]:
            sys.stdout.write(recipe_path(name).read_text(encoding="utf-8"))
        case ["check", name]:
            load_recipe(name)
            sys.stdout.write(f"{recipe_path(name)}: all fields and values are right\n")
        case _:
            raise ConfigError(f"recipes: got {' '.join(arguments)!r}; expected list, show NAME or check FILE")
    return EXIT_OK


def purpose(path: Path) -> str:
    """The first line of a recipe's opening comment: what it is for."""
    return path.read_text(encoding="utf-8").splitlines()[0].removeprefix("#").strip()


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
