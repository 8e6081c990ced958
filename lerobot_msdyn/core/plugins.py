"""Modules of the user's own that a command line names with `--plugins`; importing them registers what they hold.

Only command lines name them. A recipe or a dataset cannot: reading one must never run code. Processes that a run starts
import them again before they read its settings, and a run that was stopped goes on only with the same ones.
"""

import hashlib
import importlib
import importlib.util
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

from lerobot_msdyn.core.errors import ConfigError, first_line
from lerobot_msdyn.core.files import DIGEST_BYTES

PREFIX = "lerobot_msdyn_plugin"  # of the names of modules that are made from single files

_imported: dict[str, Path] = {}  # by name, or by absolute path: the file of each


def import_plugins(names: Iterable[str]) -> None:
    """Import modules, each given by its dotted name or as a file FILE.py; those that are imported already are left.

    A file's module gets a name of its own, so that it stands before no other module: a file random.py is none of
    Python's. What lies beside it is not found from it; a plugin of several files is a package that Python finds.

    Raises:
        ConfigError: one is absent or fails, or is a folder without an __init__.py.
    """
    for name in names:
        is_file = name.endswith(".py")
        key = str(Path(name).resolve()) if is_file else name
        if key in _imported:
            continue
        if is_file and not Path(key).is_file():
            raise ConfigError(f"--plugins: there is no file {key}")
        try:
            module = _from_file(Path(key)) if is_file else importlib.import_module(name)
        except ConfigError as error:
            raise ConfigError(f"--plugins: {name}: {error}") from error
        except (Exception, SystemExit) as error:  # a user's module can fail in any way
            raise ConfigError(
                f"--plugins: {name} cannot be imported ({first_line(error)}); expected FILE.py, or a module that "
                "Python finds"
            ) from error
        if module.__file__ is None:
            raise ConfigError(f"--plugins: {name} is a folder without an __init__.py; name a module in it")
        _imported[key] = Path(module.__file__)


def imported_plugins() -> list[str]:
    """What was imported so far, as `import_plugins` takes it in any process."""
    return list(_imported)


def plugin_digests() -> dict[str, str]:
    """Of each imported plugin a digest of its file, or of all modules of its package."""
    return {name: _digest(path) for name, path in _imported.items()}


def _digest(path: Path) -> str:
    files = sorted(path.parent.rglob("*.py")) if path.name == "__init__.py" else [path]
    total = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for file in files:
        total.update(file.read_bytes())
    return total.hexdigest()


def _from_file(path: Path) -> ModuleType:
    """A file as a module, under the same name in every process, so that what it defines can be sent to another."""
    place = hashlib.blake2b(str(path).encode(), digest_size=4).hexdigest()
    name = f"{PREFIX}_{place}_{re.sub(r'[^0-9A-Za-z_]', '_', path.stem)}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"{path} is no Python module")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
