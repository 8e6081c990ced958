"""Command lines: recipe file + dotted flags -> a config, and errors -> one line and exit code 2."""

import contextlib
import dataclasses
import difflib
import inspect
import logging
import os
import sys
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import draccus
import yaml
from draccus.wrappers.docstring import get_attribute_docstring

from lerobot_msdyn.core.config import FORMER_FIELDS, Recipe
from lerobot_msdyn.core.errors import ConfigError, MsdynError, one_line
from lerobot_msdyn.core.fields import problems
from lerobot_msdyn.core.plugins import import_plugins
from lerobot_msdyn.core.recipe_files import packaged_recipes, read_recipe

logger = logging.getLogger(__name__)

EXIT_OK = 0
EXIT_SOME_EPISODES_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130


def load_recipe(name: str) -> Recipe:
    """A recipe by its file or its name, checked.

    Raises:
        ConfigError: there is no such recipe, or a field is unknown, of the wrong type or out of range.
    """
    return parse_config(Recipe, ["--recipe", name], {}, command="load_recipe")


def parse_config[T](
    config_class: type[T], arguments: list[str], aliases: Mapping[str, str], *, command: str, recipe: str | None = None
) -> T:
    """The config that a command line describes: defaults, then `--recipe` (or `recipe`), then the other flags.

    Prints the help and exits on `-h` or `--help`.

    Raises:
        ConfigError: unknown fields (all of them named at once), wrong types or values out of range.
    """
    if "-h" in arguments or "--help" in arguments:
        plugins = []
        with contextlib.suppress(ConfigError):  # help is also for those whose flags are wrong
            plugins = _split_flags([item for item in arguments if item not in ("-h", "--help")], aliases)[1]
        import_plugins(plugins)
        sys.stdout.write(format_help(config_class, aliases, command, recipe))
        sys.exit(EXIT_OK)
    named, plugins, overrides = _split_flags(arguments, aliases)
    recipe = named if named is not None else recipe
    import_plugins(plugins)
    content: dict[str, Any] = draccus.encode(config_class())
    for part in ([read_recipe(recipe)] if recipe is not None else []) + [overrides]:
        unknown = _unknown_fields(config_class, _merge(content, part), part)
        if unknown:
            where = f"recipe {recipe}" if part is not overrides else "command line"
            raise ConfigError(f"{where}: " + "; ".join(unknown))
        content = _merge(content, part)
    try:
        config = draccus.decode(config_class, content)
    except (draccus.utils.DraccusException, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(one_line(error)) from error
    wrong = problems(config)
    if wrong:
        raise ConfigError("; ".join(wrong))
    return typing.cast(T, config)


def format_help(config_class: type, aliases: Mapping[str, str], command: str, recipe: str | None = None) -> str:
    """The help text of a command: every field with its default and the comment that stands above it."""
    names = ", ".join(f"--{alias} for --{name}" for alias, name in aliases.items())
    recipes = ", ".join(path.stem for path in packaged_recipes())
    without = "" if recipe is None else f" (default: {recipe})"
    head = (
        f"usage: {command} [--field value ...]\n\n{inspect.getdoc(config_class)}\n\n"
        f"  --recipe NAME_OR_FILE{without}\n      A YAML file with any of the fields below, read before the flags; "
        f"by name: {recipes}.\n  --plugins MODULE_OR_FILE.py\n      Your own providers, motion levels, perturbations "
        f"or loss terms, imported before the recipe is read (docs/extending.md).\n\nShort names: {names}.\n"
        "Exit codes: 0 done, or finished before; 1 some episodes or views were left out; 2 bad input; "
        "130 interrupted.\n"
    )
    return head + "".join(_help_lines(config_class, ""))


def _help_lines(config_class: type, prefix: str) -> Iterator[str]:
    hints = typing.get_type_hints(config_class)
    for item in dataclasses.fields(config_class):
        name, hint = prefix + item.name, hints[item.name]
        text = get_attribute_docstring(config_class, item.name).comment_above
        if not dataclasses.is_dataclass(hint):
            kind = getattr(hint, "__name__", str(hint)) if isinstance(hint, type) else str(hint)
            kind = kind.replace("typing.", "").replace("pathlib.", "").replace("NoneType", "None")
            yield f"  --{name} {kind} (default: {_default(item)})\n      {text}\n"
        elif issubclass(typing.cast(Any, hint), draccus.ChoiceRegistry):
            for kind, choice in sorted(typing.cast(Any, hint).get_known_choices().items()):
                yield f"\n--{name}.type {kind}: {inspect.getdoc(choice)}\n"
                yield from _help_lines(choice, f"{name}.")
        else:
            yield f"\n{name}: {inspect.getdoc(typing.cast(type, hint))}\n"
            yield from _help_lines(typing.cast(type, hint), f"{name}.")


def _default(item: dataclasses.Field) -> object:
    return item.default if item.default_factory is dataclasses.MISSING else item.default_factory()


def run_command(main: Callable[[list[str]], int], arguments: list[str] | None = None) -> None:
    """Run a command, report expected errors in one line, and exit.

    Settings of the whole process (environment, logging) are made here alone: importing the package makes none.
    Exit codes: 0 all done, 1 some episodes failed, 2 bad input, 130 interrupted.
    """
    # Idle OpenMP threads would otherwise spin on the cores that the rasterizer needs. Read when torch is loaded, which
    # is why commands import it only when they run.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s", stream=sys.stderr)
    for name in ("lerobot", "httpx"):
        logging.getLogger(name).setLevel(logging.WARNING)
    try:
        code = main(sys.argv[1:] if arguments is None else arguments)
    except MsdynError as error:
        sys.stderr.write(f"error: {one_line(error)}\n")
        code = EXIT_BAD_INPUT
    except KeyboardInterrupt:
        sys.stderr.write("interrupted: nothing was written\n")
        code = EXIT_INTERRUPTED
    sys.exit(code)


def _split_flags(arguments: list[str], aliases: Mapping[str, str]) -> tuple[str | None, list[str], dict[str, Any]]:
    """The recipe's name, the plugins, and the other flags as nested fields; values are YAML scalars or lists."""
    recipe = None
    plugins: list[str] = []
    overrides: dict[str, Any] = {}
    rest = list(arguments)
    while rest:
        flag = rest.pop(0)
        if not flag.startswith("--") or len(flag) == 2:
            raise ConfigError(f"unexpected argument {flag!r}; expected --field value (see --help)")
        name, equals, text = flag[2:].partition("=")
        if not equals:  # a flag without a value is a switch
            text = rest.pop(0) if rest and not rest[0].startswith("--") else "true"
        if name == "recipe":
            recipe = text
            continue
        try:
            value = yaml.safe_load(text) if text else text
        except yaml.YAMLError as error:
            raise ConfigError(f"--{name}: {text!r} is not a YAML value: {one_line(error)}") from error
        if name == "plugins":
            plugins += [str(item) for item in (value if isinstance(value, list) else [value])]
            continue
        target = overrides
        *parents, leaf = aliases.get(name, name).split(".")
        for parent in parents:
            target = target.setdefault(parent, {})
            if not isinstance(target, dict):
                raise ConfigError(f"--{name}: {parent!r} was given a value already")
        target[leaf] = value
    return recipe, plugins, overrides


def _merge(base: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    """`base` with the fields of `part`; a mapping whose `type` changes is replaced, not mixed."""
    merged = dict(base)
    for key, value in part.items():
        old = merged.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            changes_type = "type" in value and value["type"] != old.get("type")
            merged[key] = value if changes_type else _merge(old, value)
        else:
            merged[key] = value
    return merged


def _unknown_fields(config_class: type, merged: dict[str, Any], part: dict[str, Any], prefix: str = "") -> list[str]:
    """One line per field of `part` that the config does not have, with the nearest name that it has."""
    hints = typing.get_type_hints(config_class)
    names = [field.name for field in dataclasses.fields(config_class)]
    lines = []
    for key, value in part.items():
        if key not in names:
            former = FORMER_FIELDS.get(f"{prefix}{key}")
            if former is not None:
                lines.append(f"{prefix}{key} is a field no more: {former}")
                continue
            near = difflib.get_close_matches(str(key), names, n=1)
            hint = f", did you mean {prefix + near[0]!r}?" if near else f"; expected one of {', '.join(names)}"
            lines.append(f"unknown field {prefix + str(key)!r}{hint}")
            continue
        field_class = hints[key]
        if typing.get_origin(field_class) is dict and not isinstance(value, dict):
            lines.append(f"{prefix + key!r} is {value!r}; expected a mapping")
        if not dataclasses.is_dataclass(field_class):
            if field_class is str and isinstance(value, list | dict):
                lines.append(f"{prefix + key!r} is {value!r}; expected text")
            continue
        if not isinstance(value, dict):
            lines.append(f"{prefix + key!r} is {value!r}; expected a mapping of its fields")
            continue
        inner = dict(value)
        if isinstance(field_class, type) and issubclass(field_class, draccus.ChoiceRegistry):
            kind = merged[key].get("type")
            choices = typing.cast(Any, field_class).get_known_choices()
            inner.pop("type", None)
            if kind not in choices:
                lines.append(f"{prefix + key}.type is {kind!r}; expected one of {', '.join(sorted(choices))}")
                continue
            field_class = choices[kind]
        lines += _unknown_fields(typing.cast(type, field_class), merged[key], inner, f"{prefix + key}.")
    return lines
