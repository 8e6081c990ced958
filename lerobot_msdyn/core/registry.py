"""Named implementations of one kind, each a file of its own, open to other packages.

A built-in one is a module NAME.py in the registry's folder, which registers itself when it is imported; it is imported
when it is first asked for. One of another package is an entry point NAME in the group that is called as the folder is,
or is registered by a module that `--plugins` imports. docs/extending.md shows one of each.
"""

import importlib
import importlib.metadata
import importlib.util
import pkgutil
from collections.abc import Callable
from typing import Any

from lerobot_msdyn.core.errors import ConfigError


class Registry[T]:
    """Implementations by name."""

    def __init__(self, kind: str, folder: str) -> None:
        """Make an empty one.

        Args:
            kind: what is registered, for messages ("depth provider").
            folder: package of the built-in ones, also the group of entry points; it holds nothing else.
        """
        self.kind = kind
        self.folder = folder
        self._known: dict[str, T] = {}

    def register[S](self, name: str) -> Callable[[S], S]:
        """Decorator: the implementation of this name.

        Raises:
            ConfigError: another one has the name already.
        """

        def registered(implementation: S) -> S:
            self.add(name, implementation)  # type: ignore[arg-type]  # a decorator's type is checked where it is used
            return implementation

        return registered

    def add(self, name: str, implementation: T) -> None:
        """The same as a call.

        Raises:
            ConfigError: another one has the name already.
        """
        other = self._known.get(name)
        if other is not None and _origin(other) != _origin(implementation):
            raise ConfigError(
                f"{self.kind} {name!r} is registered twice: by {_origin(other)}, {_origin(implementation)}"
            )
        self._known[name] = implementation

    def names(self) -> list[str]:
        """All names, sorted; nothing is imported to tell them."""
        return sorted({*self._known, *self._files(), *self._entry_points()})

    def __contains__(self, name: object) -> bool:
        return name in self.names()

    def get(self, name: str) -> T:
        """The implementation of a name.

        Raises:
            ConfigError: there is none, or its package cannot be imported.
        """
        if name not in self._known:
            if name in self._files():
                importlib.import_module(f"{self.folder}.{name}")
            elif name in (points := self._entry_points()):
                self.add(name, _loaded(points[name], self.kind))
        if name not in self._known:
            raise ConfigError(f"no {self.kind} {name!r}; expected one of {', '.join(self.names())}")
        return self._known[name]

    def name_of(self, implementation: T) -> str:
        """The name of one that was registered.

        Raises:
            ValueError: it was not.
        """
        for name, known in self._known.items():
            if known is implementation:
                return name
        raise ValueError(f"{implementation} is no registered {self.kind}")

    def all(self) -> dict[str, T]:
        """All implementations by name; imports them."""
        return {name: self.get(name) for name in self.names()}

    def _files(self) -> set[str]:
        spec = importlib.util.find_spec(self.folder)
        places = spec.submodule_search_locations if spec is not None else None
        return {module.name for module in pkgutil.iter_modules(places or [])}

    def _entry_points(self) -> dict[str, importlib.metadata.EntryPoint]:
        return {point.name: point for point in importlib.metadata.entry_points(group=self.folder)}


def _origin(implementation: object) -> str:
    """Module and name of a class or function; of a value, those of its class."""
    named = implementation if hasattr(implementation, "__qualname__") else type(implementation)
    return f"{named.__module__}.{getattr(named, '__qualname__', '')}"


def _loaded(point: importlib.metadata.EntryPoint, kind: str) -> Any:
    try:
        return point.load()
    except Exception as error:  # another package's import can fail in any way
        raise ConfigError(f"{kind} {point.name!r} of {point.value} cannot be imported ({error})") from error
