"""Plain values (nested dataclasses of tensors) to and from one file each, and from one device to another.

The file is safetensors: arrays as such, everything else as JSON in its header. Floats and arrays come back bit for bit.
Only dataclasses of this package are made from a file, by their fields; nothing in it is executed.
"""

import dataclasses
import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from lerobot_msdyn.core.errors import MsdynError
from lerobot_msdyn.core.files import write_whole

PACKAGE = __name__.split(".")[0]
HEADER = "value"


class ValueFileError(MsdynError):
    """A file is damaged, or holds values that this version does not have."""


def save_value(path: Path, value: object, base: Path) -> None:
    """Write a value; paths in it are kept relative to `base`. The file is complete or absent.

    Raises:
        TypeError: the value holds something else than None, bool, int, float, str, Path, arrays, and lists, tuples,
            text-keyed dictionaries and this package's dataclasses of them.
    """
    arrays: dict[str, Tensor] = {}
    header = json.dumps(_encoded(value, arrays, base))
    write_whole(path, save(arrays, metadata={HEADER: header}))


def load_value(path: Path, base: Path) -> Any:
    """The value that `save_value` wrote.

    Raises:
        ValueFileError: the file cannot be read.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {})[HEADER])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return _decoded(header, arrays, base)
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, AttributeError, ImportError) as error:
        raise ValueFileError(f"{path} cannot be read ({type(error).__name__}: {error})") from error


def to_device[T](value: T, device: torch.device | str) -> T:
    """The same value with its tensors on a device; one of tensors, dataclasses, lists, tuples and dictionaries."""
    moved: Any = value
    if isinstance(value, Tensor):
        moved = value.to(device)
    elif isinstance(value, list | tuple):
        moved = type(value)(to_device(item, device) for item in value)
    elif isinstance(value, dict):
        moved = {key: to_device(item, device) for key, item in value.items()}
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [item.name for item in dataclasses.fields(value)]
        moved = dataclasses.replace(value, **{name: to_device(getattr(value, name), device) for name in names})
    return moved


def _encoded(value: object, arrays: dict[str, Tensor], base: Path) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Tensor | np.ndarray):
        name = str(len(arrays))
        arrays[name] = torch.as_tensor(value).detach().cpu().contiguous().clone()
        return {"tensor" if isinstance(value, Tensor) else "array": name}
    if isinstance(value, Path):
        return {"path": str(value.relative_to(base))}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_encoded(item, arrays, base) for item in value]}
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {"dict": {key: _encoded(item, arrays, base) for key, item in value.items()}}
    kind = type(value)
    if dataclasses.is_dataclass(value) and kind.__module__.split(".")[0] == PACKAGE:
        content = {item.name: _encoded(getattr(value, item.name), arrays, base) for item in dataclasses.fields(value)}
        return {"class": f"{kind.__module__}:{kind.__qualname__}", "fields": content}
    raise TypeError(f"a {kind.__name__} cannot be kept in a file")


def _decoded(value: Any, arrays: dict[str, Tensor], base: Path) -> Any:
    match value:
        case {"tensor": name}:
            return arrays[name]
        case {"array": name}:
            return arrays[name].numpy()
        case {"path": relative}:
            return base / relative
        case {"list": items}:
            return [_decoded(item, arrays, base) for item in items]
        case {"tuple": items}:
            return tuple(_decoded(item, arrays, base) for item in items)
        case {"dict": items}:
            return {key: _decoded(item, arrays, base) for key, item in items.items()}
        case {"class": name, "fields": content}:
            kind = _dataclass_named(name)
            return kind(**{key: _decoded(item, arrays, base) for key, item in content.items()})
        case _:
            return value


def _dataclass_named(name: str) -> type:
    module, _, kind_name = name.partition(":")
    kind = getattr(importlib.import_module(module), kind_name) if module.split(".")[0] == PACKAGE else None
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise ValueError(f"{name} is not a dataclass of {PACKAGE}")
    return kind
