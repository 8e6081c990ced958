"""An object store that holds the work folder of a job (`dataset.staging`), for nodes without a common file system.

Each node has a part of that folder. An object appears whole; the one that says that others are complete is put last.
"""

from pathlib import Path, PurePosixPath

from fsspec.core import url_to_fs

from lerobot_msdyn.core.errors import OutputError, first_line
from lerobot_msdyn.core.files import whole_file
from lerobot_msdyn.dataset.staging import LOCK


class Store:
    """A prefix in an object store; names are relative to it."""

    def __init__(self, url: str) -> None:
        """Open it: any URL that fsspec knows, s3://bucket/prefix among them.

        Raises:
            OutputError: there is no such kind of store, or it needs a library that is absent.
        """
        try:
            self._files, root = url_to_fs(url)
        except (ValueError, ImportError) as error:
            raise OutputError(f"--store {url}: {first_line(error)}") from error
        self._root, self.url = root.rstrip("/"), url.rstrip("/")

    def names(self, pattern: str) -> list[str]:
        """The objects whose names match, e.g. episodes/*/finished.safetensors."""
        self._files.invalidate_cache()
        return sorted(self._name(str(path)) for path in self._files.glob(f"{self._root}/{pattern}"))

    def get(self, name: str, folder: Path) -> None:
        """Copy an object, or all below a name, into a folder that mirrors the store; nothing where there is none."""
        self._files.invalidate_cache()
        path = f"{self._root}/{name}"
        for found in self._files.find(path) if self._files.exists(path) else []:
            place = folder / self._name(str(found))
            place.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(place) as part:
                self._files.get_file(str(found), str(part))

    def put(self, path: Path, name: str, last: str = "") -> None:
        """Copy a file, or all of a folder but its lock, to a name; the file called `last` at the end."""
        files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
        for file in sorted((file for file in files if file.name != LOCK), key=lambda file: file.name == last):
            target = PurePosixPath(self._root, name, *file.relative_to(path).parts)
            self._files.makedirs(str(target.parent), exist_ok=True)
            self._files.put_file(str(file), str(target))

    def remove(self, name: str) -> None:
        """Remove an object, or all below a name."""
        path = f"{self._root}/{name}"
        if self._files.exists(path):
            self._files.rm(path, recursive=True)

    def _name(self, path: str) -> str:
        return path.removeprefix(self._root).lstrip("/")
