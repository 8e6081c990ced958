"""What the fields of a config may hold, written on the fields themselves."""

from dataclasses import field, fields, is_dataclass
from typing import Any

from lerobot_msdyn.core.registry import Registry

Number = int | float

INFINITY = float("inf")
AUTO = "auto"  # the best of what can be used
FILE = ".npz"  # ending of an exchange file
PARAMETER = ":"  # between the name of an implementation and what it is to take
MAX_INDEX = 1_000_000_000  # of an episode
MAX_SEED = 4_294_967_295
MAX_WEIGHT = 1e6  # of a loss term


def between(default: Number | None, low: Number, high: Number) -> Any:
    """A number from `low` to `high`; where the default is none, also none."""
    return field(default=default, metadata={"range": (low, high)})


def one_of(default: str, names: tuple[str, ...], *, registry: Registry | None = None) -> Any:
    """One of some names, of the implementations in a registry (as NAME or NAME:PARAMETER), or a file FILE.npz."""
    return field(default=default, metadata={"names": names, "registry": registry})


def numbers_of(defaults: dict[str, Any], low: Number, high: Number, *, registry: Registry) -> Any:
    """A number from `low` to `high` for some of the implementations in a registry."""
    return field(default_factory=lambda: dict(defaults), metadata={"range": (low, high), "keys": registry})


def problems(config: Any, prefix: str = "") -> list[str]:
    """One line per value that is not allowed, over all nested fields.

    A config class that has rules between its fields says so in a method `problems`.
    """
    lines = []
    for item in fields(config):
        value = getattr(config, item.name)
        name = prefix + item.name
        if is_dataclass(value):
            lines += problems(value, f"{name}.")
        elif isinstance(value, dict):
            lines += _dict_problems(value, name, item.metadata)
        elif "range" in item.metadata and not (value is None and item.default is None):
            lines += _range_problems(value, name, *item.metadata["range"])
        elif "names" in item.metadata:
            registry: Registry | None = item.metadata["registry"]
            registered = registry.names() if registry is not None else []
            allowed = [*item.metadata["names"], *registered]
            with_parameter = PARAMETER in value and value.partition(PARAMETER)[0] in registered
            if value not in allowed and not with_parameter and not value.endswith(FILE):
                lines.append(f"{name} is {value!r}; expected {', '.join(allowed)} or a file FILE{FILE}")
    between_fields = getattr(config, "problems", None)
    return lines + ([prefix + line for line in between_fields()] if between_fields is not None else [])


def _dict_problems(values: dict[str, Any], name: str, metadata: Any) -> list[str]:
    lines = []
    keys: Registry | None = metadata.get("keys")
    for key, value in values.items():
        if keys is not None and key not in keys:
            lines.append(f"{name}.{key} is unknown; expected one of {', '.join(keys.names())}")
        elif "range" in metadata:
            lines += _range_problems(value, f"{name}.{key}", *metadata["range"])
    return lines


def _range_problems(value: Number, name: str, low: Number, high: Number) -> list[str]:
    return [] if low <= value <= high else [f"{name} is {value}; expected a value from {low} to {high}"]
