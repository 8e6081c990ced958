"""Named implementations of one kind, each in a file of its own, open to other packages.

A built-in one is a module NAME.py in the registry's folder; it registers itself when it is imported, which is when it
is first asked for. One of another package is an entry point NAME whose group is the folder's dotted name:

    [project.entry-points."lerobot_msdyn.priors.depth.providers"]
    my_depth = "my_package.my_depth:MyDepth"

or is registered by a module that a command line names with `--plugins`. docs/extending.md shows one of each.
"""

import functools
import importlib
import importlib.metadata
import importlib.util
import pkgutil
import sys
from collections.abc import Callable
from types import ModuleType

from lerobot_msdyn.core.errors import ConfigError, first_line

PACKAGE = "lerobot_msdyn"


class Registry[T]:
    """Implementations by name."""

    def __init__(self, kind: str, folder: str) -> None:
        """Make an empty one.

        Args:
            kind: what is registered, for messages ("depth provider").
            folder: package of the built-in ones, also the group of entry points. It holds nothing else, but modules
                whose name begins with an underscore.
        """
        self.kind = kind
        self.folder = folder
        self._registered: dict[str, T] = {}

    def register[S](self, name: str) -> Callable[[S], S]:
        """Decorator: the implementation of this name.

        Raises:
            ConfigError: another one has the name already, or it cannot be written in a recipe.
        """

        def registered(implementation: S) -> S:
            self.add(name, implementation)  # type: ignore[arg-type]  # a decorator's type is checked where it is used
            return implementation

        return registered

    def add(self, name: str, implementation: T) -> None:
        """The same as a call.

        Raises:
            ConfigError: another one has the name already, or it cannot be written in a recipe.
        """
        if not name.isidentifier():
            raise ConfigError(f"{self.kind} {name!r}: expected a name of letters, digits and underscores")
        here = _place_of(implementation)
        other = self._registered.get(name)
        if other is not None and other != implementation and _place_of(other) != here:
            raise self._registered_twice(name, _place_of(other), here)
        if other is None and name in self._files() and self._module(name) not in sys.modules:
            raise self._registered_twice(name, self._module(name), here)
        self._registered[name] = implementation

    def names(self) -> list[str]:
        """All names, sorted; nothing is imported to tell them."""
        return sorted({*self._registered, *self._files(), *(point.name for point in self._entry_points())})

    def __contains__(self, name: object) -> bool:
        return name in self.names()

    def get(self, name: str) -> T:
        """The implementation of a name.

        Raises:
            ConfigError: there is none, several have the name, or its module cannot be imported or does not register it.
        """
        if name not in self._registered:
            self._load(name)
        return self._registered[name]

    def name_of(self, implementation: T) -> str:
        """The name of one that was registered.

        Raises:
            ValueError: it was not.
        """
        for name, registered in self._registered.items():
            if registered is implementation:
                return name
        raise ValueError(f"{implementation} is no registered {self.kind}")

    def all(self) -> dict[str, T]:
        """All implementations by name; imports them."""
        return {name: self.get(name) for name in self.names()}

    def _load(self, name: str) -> None:
        points = [point for point in self._entry_points() if point.name == name]
        places = ([self._module(name)] if name in self._files() else []) + sorted({point.value for point in points})
        if not places:
            raise ConfigError(f"no {self.kind} {name!r}; expected one of {', '.join(self.names())}")
        if len(places) > 1:
            raise self._registered_twice(name, *places[:2])
        try:
            loaded = points[0].load() if points else importlib.import_module(places[0])
        except Exception as error:  # another package's import can fail in any way
            raise ConfigError(f"{self.kind} {name!r}: {places[0]} cannot be imported ({first_line(error)})") from error
        if name not in self._registered and not isinstance(loaded, ModuleType):
            self.add(name, loaded)
        if name not in self._registered:
            raise ConfigError(f"{self.kind} {name!r}: {places[0]} registers nothing under this name")

    def _module(self, name: str) -> str:
        return f"{self.folder}.{name}"

    def _files(self) -> set[str]:
        spec = importlib.util.find_spec(self.folder)
        places = spec.submodule_search_locations if spec is not None else None
        return {module.name for module in pkgutil.iter_modules(places or []) if not module.name.startswith("_")}

    def _entry_points(self) -> importlib.metadata.EntryPoints:
        return _all_entry_points().select(group=self.folder)

    def _registered_twice(self, name: str, first: str, second: str) -> ConfigError:
        return ConfigError(f"{self.kind} {name!r} is registered twice: by {first} and by {second}; rename one of them")


def extending_packages() -> dict[str, str]:
    """The installed packages with entry points for any registry of this one, and their versions."""
    points = [point for point in _all_entry_points() if point.group.startswith(f"{PACKAGE}.")]
    return {point.dist.name: point.dist.version for point in points if point.dist is not None}


@functools.cache
def _all_entry_points() -> importlib.metadata.EntryPoints:
    """Those of all installed packages; to look takes a tenth of a second."""
    return importlib.metadata.entry_points()


def _place_of(implementation: object) -> str:
    """Name and file of a class or function; of a value, those of its class."""
    named = implementation if hasattr(implementation, "__qualname__") else type(implementation)
    module = sys.modules.get(named.__module__)
    return f"{getattr(named, '__qualname__', '')} of {getattr(module, '__file__', None) or named.__module__}"
