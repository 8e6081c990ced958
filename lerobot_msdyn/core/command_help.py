"""The help texts of the commands, from their configs: the essentials by `--help`, every field by `--help-all`."""

import dataclasses
import inspect
import re
import typing
from collections.abc import Iterator, Mapping
from typing import Any

import draccus
from draccus.wrappers.docstring import get_attribute_docstring

from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.recipe_files import packaged_recipes

EXIT_CODES = (
    "Exit codes: 0 done, or finished before; 1 some episodes or views were left out; 2 bad input; 130 interrupted."
)


@dataclasses.dataclass(frozen=True)
class Essentials:
    """What the short help of a command shows."""

    fields: tuple[str, ...]
    examples: tuple[str, ...]  # arguments


def format_essentials(config_class: type, aliases: Mapping[str, str], command: str, essentials: Essentials) -> str:
    """The short help: what the command is for, examples, and the fields that matter most."""
    flags = {name: f"--{alias}" for alias, name in aliases.items()}
    shown = [("--recipe NAME_OR_FILE", f"By name ({_recipes()}) or a YAML file")]
    fields = {item.name: item for item in dataclasses.fields(config_class)}
    for name in essentials.fields:
        default = _default(fields[name])
        text = _first_clause(config_class, name) + (
            f" (default: {default})" if default not in ("", None, False) else ""
        )
        shown.append((flags.get(name, f"--{name}"), text))
    width = max(len(flag) for flag, _ in shown)
    examples = "".join(f"  {command} {example}\n" for example in essentials.examples)
    options = "".join(f"  {flag:{width}s}  {text}\n" for flag, text in shown)
    return f"{_purpose(config_class)}\n\n{examples}\n{options}\nAll settings: {command} --help-all\n{EXIT_CODES}\n"


def format_help(config_class: type, aliases: Mapping[str, str], command: str, recipe: str | None = None) -> str:
    """The whole help: every field with its type, its default and the comment that stands above it."""
    names = ", ".join(f"--{alias} for --{name}" for alias, name in aliases.items() if alias != name)
    without = "" if recipe is None else f" (default: {recipe})"
    recipes = (
        f"  --recipe NAME_OR_FILE{without}\n      A YAML file with any of the fields below, read before the flags; "
        f"by name: {_recipes()}.\n  --plugins MODULE_OR_FILE.py\n      Your own providers, motion levels, "
        f"perturbations or loss terms, imported before the recipe is read (docs/extending.md).\n\n"
    )
    head = (
        f"usage: {command} [--field value ...]\n\n{inspect.getdoc(config_class)}\n\n"
        f"{recipes if issubclass(config_class, Recipe) else ''}"
        f"{f'Short names: {names}.{chr(10)}' if names else ''}{EXIT_CODES}\n"
    )
    return head + "".join(_lines(config_class, ""))


def _recipes() -> str:
    return ", ".join(path.stem for path in packaged_recipes())


def _purpose(config_class: type) -> str:
    """The summary of a config's docstring without the command's name."""
    summary = (inspect.getdoc(config_class) or "").splitlines()[0]
    text = summary.partition("`: ")[2] or summary
    return text[0].upper() + text[1:]


def _comment(config_class: type, name: str) -> str:
    return get_attribute_docstring(config_class, name).comment_above


def _first_clause(config_class: type, name: str) -> str:
    """What a field's comment says before its first semicolon or the end of its first sentence, in one line."""
    text = " ".join(_comment(config_class, name).split())
    return re.split(r"; | \(alias|\.(?: (?=[A-Z])|$)", text)[0]


def _lines(config_class: type, prefix: str) -> Iterator[str]:
    hints = typing.get_type_hints(config_class)
    for item in dataclasses.fields(config_class):
        name, hint = prefix + item.name, hints[item.name]
        text = _comment(config_class, item.name)
        if not dataclasses.is_dataclass(hint):
            kind = getattr(hint, "__name__", str(hint)) if isinstance(hint, type) else str(hint)
            kind = kind.replace("typing.", "").replace("pathlib.", "").replace("NoneType", "None")
            yield f"  --{name} {kind} (default: {_default(item)})\n      {text}\n"
        elif issubclass(typing.cast(Any, hint), draccus.ChoiceRegistry):
            for kind, choice in sorted(typing.cast(Any, hint).get_known_choices().items()):
                yield f"\n--{name}.type {kind}: {inspect.getdoc(choice)}\n"
                yield from _lines(choice, f"{name}.")
        else:
            yield f"\n{name}: {inspect.getdoc(typing.cast(type, hint))}\n"
            yield from _lines(typing.cast(type, hint), f"{name}.")


def _default(item: dataclasses.Field) -> object:
    if item.default_factory is not dataclasses.MISSING:
        return item.default_factory()
    return "none: it must be given" if item.default is dataclasses.MISSING else item.default
