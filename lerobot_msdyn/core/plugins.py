"""Modules of the user's own that a command line names with `--plugins`; importing them registers what they hold.

Only command lines name them. A recipe or a dataset cannot: reading one must never run code.
"""

import importlib
import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

from lerobot_msdyn.core.errors import ConfigError

_files: dict[str, Path] = {}  # what was imported, and from where


def import_plugins(names: Iterable[str]) -> None:
    """Import modules, each given by its dotted name or as a file FILE.py.

    Raises:
        ConfigError: one is absent or fails.
    """
    for name in names:
        if name in _files:
            continue
        try:
            module = _from_file(Path(name)) if name.endswith(".py") else importlib.import_module(name)
        except ConfigError:
            raise
        except Exception as error:  # a user's module can fail in any way
            raise ConfigError(
                f"--plugins: {name} cannot be imported ({type(error).__name__}: {error}); "
                "expected FILE.py, or a module that Python finds"
            ) from error
        _files[name] = Path(module.__file__ or "")


def imported_plugins() -> dict[str, Path]:
    """What was imported so far: as it was named -> its file."""
    return dict(_files)


def _from_file(path: Path) -> ModuleType:
    """A file as a module of its stem's name, so that other processes can find what it defines."""
    spec = importlib.util.spec_from_file_location(path.stem, path.resolve())
    if spec is None or spec.loader is None or not path.is_file():
        raise ConfigError(f"--plugins: no file {path}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module
