"""Plain values (nested dataclasses of tensors) as named tensors and back, in files, and on one device or another.

Files are safetensors. `save_value` keeps any value: tensors as such, everything else as JSON in the header; floats and
tensors come back bit for bit. Only dataclasses of this package, and those that `allow` names, are made from a file, by
their fields; nothing in it is executed.
"""

import dataclasses
import importlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load, save
from torch import Tensor

from lerobot_msdyn.core.errors import MsdynError
from lerobot_msdyn.core.files import write_whole

PACKAGE = __name__.split(".")[0]
HEADER = "value"
SMALL = 1_000_000  # bytes of a file that is read whole: of one kept open, safetensors leaks 60 bytes per tensor
_allowed: dict[str, type] = {}  # dataclasses of other packages


class ValueFileError(MsdynError):
    """A file is damaged, or holds values that this version does not have."""


def allow(kind: type) -> None:
    """Let files hold a dataclass of another package, such as the value of a registered motion level."""
    _allowed[_name_of(kind)] = kind


def named_tensors(value: object, name: str = "") -> dict[str, Tensor]:
    """All tensors in a value of dataclasses, dictionaries, lists and tuples, by dotted names that begin with `name`."""
    tensors: dict[str, Tensor] = {}
    _encoded(value, tensors, Path(), name)
    return tensors


def from_named_tensors[T](kind: type[T], tensors: Mapping[str, Tensor], name: str = "") -> T:
    """A dataclass of tensors alone, as `named_tensors` named them.

    Raises:
        KeyError: one is missing.
    """
    names = [item.name for item in dataclasses.fields(kind)]  # type: ignore[arg-type]  # a dataclass
    return kind(**{item: tensors[_joined(name, item)] for item in names})


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None) -> None:
    """Write tensors as one safetensors file, which is complete or absent."""
    plain = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    write_whole(path, save(plain, metadata=metadata))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors and the metadata of a safetensors file.

    Raises:
        OSError, ValueError, SafetensorError: it is absent or damaged.
    """
    if path.stat().st_size < SMALL:
        content = path.read_bytes()
        return load(content), _metadata(content)
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118


def _metadata(content: bytes) -> dict[str, str]:
    """Of a safetensors file that `load` has found sound: its first 8 bytes say how long the header is."""
    header: dict[str, Any] = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    return dict(header.get("__metadata__", {}))


def save_value(path: Path, value: object, base: Path) -> None:
    """Write a value; paths in it are kept relative to `base`. The file is complete or absent.

    Raises:
        TypeError: the value holds something else than None, bool, int, float, str, Path, arrays, and lists, tuples,
            text-keyed dictionaries and dataclasses of this package, or that `allow` names, of them.
    """
    arrays: dict[str, Tensor] = {}
    header = json.dumps(_encoded(value, arrays, base, ""))
    write_tensors(path, arrays, {HEADER: header})


def load_value(path: Path, base: Path) -> Any:
    """The value that `save_value` wrote.

    Raises:
        ValueFileError: the file cannot be read.
    """
    try:
        arrays, metadata = read_tensors(path)
        return _decoded(json.loads(metadata[HEADER]), arrays, base)
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


def _encoded(value: object, arrays: dict[str, Tensor], base: Path, name: str) -> Any:
    """A value as JSON; its arrays are put beside, under dotted names that begin with `name`."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Tensor | np.ndarray):
        while name in arrays or not name:  # keys of dictionaries may hold dots
            name += "_"
        arrays[name] = torch.as_tensor(value)
        return {"tensor" if isinstance(value, Tensor) else "array": name}
    if isinstance(value, Path):
        return {"path": str(value.relative_to(base))}
    if isinstance(value, list | tuple):
        items = [_encoded(item, arrays, base, _joined(name, str(i))) for i, item in enumerate(value)]
        return {type(value).__name__: items}
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {"dict": {key: _encoded(item, arrays, base, _joined(name, key)) for key, item in value.items()}}
    kind = type(value)
    if dataclasses.is_dataclass(value) and (_is_own(kind.__module__) or _name_of(kind) in _allowed):
        names = [item.name for item in dataclasses.fields(value)]
        content = {item: _encoded(getattr(value, item), arrays, base, _joined(name, item)) for item in names}
        return {"class": _name_of(kind), "fields": content}
    raise TypeError(f"a {kind.__name__} cannot be kept in a file")


def _decoded(value: Any, arrays: dict[str, Tensor], base: Path) -> Any:
    match value:
        case {"tensor": name}:
            return arrays[name]
        case {"array": name}:
            return arrays[name].numpy().copy()  # a tensor that was read keeps its whole file mapped
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
    if name in _allowed:
        return _allowed[name]
    module, _, kind_name = name.partition(":")
    kind = getattr(importlib.import_module(module), kind_name) if _is_own(module) else None
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise ValueError(f"{name} is not a dataclass of {PACKAGE}, and no plugin has registered it")
    return kind


def _is_own(module: str) -> bool:
    return module.split(".")[0] == PACKAGE


def _name_of(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _joined(name: str, part: str) -> str:
    return f"{name}.{part}" if name else part
