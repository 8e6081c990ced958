"""Command lines: recipe file + dotted flags -> a config, and errors -> one line and exit code 2."""

import contextlib
import dataclasses
import difflib
import logging
import os
import re
import sys
import typing
from collections.abc import Callable, Mapping
from importlib.metadata import version
from typing import Any

import draccus
import yaml

from lerobot_msdyn.core.command_help import Essentials, format_essentials, format_help
from lerobot_msdyn.core.config import FORMER_FIELDS, Recipe
from lerobot_msdyn.core.errors import ConfigError, MsdynError, one_line
from lerobot_msdyn.core.fields import problems
from lerobot_msdyn.core.plugins import import_plugins
from lerobot_msdyn.core.recipe_files import read_recipe

logger = logging.getLogger(__name__)

EXIT_OK = 0
EXIT_SOME_EPISODES_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
HELP = {"-h": False, "--help": False, "--help-all": True, "--help_all": True}  # whether every field is shown


def load_recipe(name: str) -> Recipe:
    """A recipe by its file or its name, checked.

    Raises:
        ConfigError: there is no such recipe, or a field is unknown, of the wrong type or out of range.
    """
    return parse_config(Recipe, ["--recipe", name], {}, command="load_recipe")


def parse_config[T](
    config_class: type[T],
    arguments: list[str],
    aliases: Mapping[str, str],
    *,
    command: str,
    recipe: str | None = None,
    essentials: Essentials | None = None,
) -> T:
    """The config that a command line describes: defaults, then `--recipe` (or `recipe`), then the other flags.

    Prints the help and exits on `-h`, `--help` (the essentials, where a command names them) or `--help-all`.

    Raises:
        ConfigError: unknown fields (all of them named at once), wrong types or values out of range.
    """
    if any(item in HELP for item in arguments):
        plugins = []
        with contextlib.suppress(ConfigError):  # help is also for those whose flags are wrong
            plugins = _split_flags([item for item in arguments if item not in HELP], aliases)[1]
        import_plugins(plugins)
        if essentials is None or any(HELP.get(item) for item in arguments):
            sys.stdout.write(format_help(config_class, aliases, command, recipe))
        else:
            sys.stdout.write(format_essentials(config_class, aliases, command, essentials))
        sys.exit(EXIT_OK)
    named, plugins, overrides = _split_flags(arguments, aliases)
    recipe = named if named is not None else recipe
    import_plugins(plugins)
    overrides = _lists(config_class, overrides)
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


def listed(value: object, item: type) -> object:
    """What a flag gives for a field that is a list: one value, values between commas, and ranges such as 0-9.

    Raises:
        ConfigError: a range that ends before it begins.
    """
    if isinstance(value, str) and value:
        return [part for text in value.split(",") for part in _range(text.strip(), item)]
    return [value] if isinstance(value, int) and item is int else value


def _range(text: str, item: type) -> list[Any]:
    found = re.fullmatch(r"(\d+)-(\d+)", text) if item is int else None
    if found is None:
        return [int(text)] if item is int and text.isdecimal() else [text]
    first, last = map(int, found.groups())
    if last < first:
        raise ConfigError(f"{text!r} is no range: it ends before it begins; expected {last}-{first}")
    return list(range(first, last + 1))


def _lists(config_class: type, part: dict[str, Any]) -> dict[str, Any]:
    """`part` with lists where the config's own fields are lists and less was typed."""
    hints = typing.get_type_hints(config_class)
    items = {name: _item_of(hint) for name, hint in hints.items()}
    return {name: value if items.get(name) is None else listed(value, items[name]) for name, value in part.items()}


def _item_of(hint: object) -> Any:
    """T where a hint is list[T] or list[T] | None, else None."""
    for option in (hint, *typing.get_args(hint)):
        if typing.get_origin(option) is list:
            return typing.get_args(option)[0]
    return None


def quiet_libraries() -> None:
    """Libraries that say at length what they do (codecs, requests) only warn from now on, in this process."""
    for name in ("lerobot", "httpx", "fsspec", "botocore"):
        logging.getLogger(name).setLevel(logging.WARNING)


def run_command(main: Callable[[list[str]], int], arguments: list[str] | None = None) -> None:
    """Run a command, report expected errors in one line, and exit.

    Settings of the whole process (environment, logging) are made here alone: importing the package makes none.
    Exit codes: 0 all done, 1 some episodes failed, 2 bad input, 130 interrupted.
    """
    # Idle OpenMP threads would otherwise spin on the cores that the rasterizer needs. Read when torch is loaded, which
    # is why commands import it only when they run.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    shown = logging.StreamHandler(sys.stderr)
    shown.setFormatter(_Lines())
    logging.basicConfig(level=logging.INFO, handlers=[shown])
    quiet_libraries()
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        sys.stdout.write(f"lerobot_msdyn {version('lerobot_msdyn')}\n")
        sys.exit(EXIT_OK)
    try:
        code = main(arguments)
    except MsdynError as error:
        sys.stderr.write(f"error: {one_line(error)}\n")
        code = EXIT_BAD_INPUT
    except KeyboardInterrupt:
        sys.stderr.write("interrupted: nothing was written\n")
        code = EXIT_INTERRUPTED
    sys.exit(code)


class _Lines(logging.Formatter):
    """What a command says, as a line; warnings and errors are marked."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return text if record.levelno <= logging.INFO else f"{record.levelname.lower()}: {text}"


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
        name = name.replace("-", "_") if name not in aliases else name
        if not equals:  # a flag without a value is a switch
            text = rest.pop(0) if rest and not rest[0].startswith("--") else "true"
        if name == "recipe":
            recipe = text
            continue
        try:
            value = yaml.safe_load(text) if text else text
        except yaml.YAMLError as error:
            raise ConfigError(f"--{name}: {text!r} is not a YAML value: {one_line(error)}") from error
        if isinstance(value, int) and ":" in text:  # YAML would have 04:00:00 be a number to base 60
            value = text
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
            if value is None and type(None) not in typing.get_args(field_class):
                lines.append(f"{prefix + key!r} is null; expected a value")
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
