"""Computed priors on disk, so that the same video with the same settings is computed once.

    FOLDER/<digest of the video's pixels>/<prior>-<provider>-<digest of the settings>.npz

The pixels stand for dataset, episode and camera. The settings include everything that the result depends on, the code
of this package's priors, and the file of a provider from elsewhere, so that results of older code are never taken.
Files appear by one rename. Nothing is ever deleted: remove the folder at any time to get the disk space back.
"""

import functools
import hashlib
import json
import logging
import os
import sys
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from torch import Tensor

from lerobot_msdyn.core.files import CACHE_VARIABLE, cache_folder, digest_of_file

logger = logging.getLogger(__name__)

Arrays = dict[str, np.ndarray]

_DIGEST = 16  # bytes
_OFF = ("off", "False")  # YAML reads off as false


@dataclass(frozen=True)
class PriorCache:
    """The results for one video."""

    folder: Path | None  # None: nothing is kept

    def get(self, prior: str, provider: str, settings: dict[str, Any], compute: Callable[[], Arrays]) -> Arrays:
        """The arrays of an earlier run with these settings, else those that `compute` returns, which are then kept.

        Where the folder cannot be written nothing is kept, and a warning says so.

        Args:
            prior: masks, depth or tracks.
            provider: its name.
            settings: what the result depends on besides the video and the code, as JSON.
            compute: makes the arrays; the file that defines it counts as the provider's code.
        """
        if self.folder is None:
            return compute()
        content = json.dumps({"settings": settings, "code": _code_of(compute)}, sort_keys=True, default=str)
        path = self.folder / f"{prior}-{provider}-{_digest(content.encode())}.npz"
        kept = _read(path)
        if kept is not None:
            logger.debug("%s: taken from %s", prior, path)
            return kept
        arrays = compute()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            save_npz(path, arrays)
        except OSError as error:
            logger.warning(
                "%s cannot be written (%s): %s is not kept; priors.cache or %s names another folder",
                path,
                error,
                prior,
                CACHE_VARIABLE,
            )
        return arrays


def open_cache(setting: str, rgb: UInt8[Tensor, "t h w 3"]) -> PriorCache:
    """The cache of a video under the folder that the setting names: `auto`, `off`, or the folder itself."""
    if setting in _OFF:
        return PriorCache(None)
    folder = cache_folder("priors") if setting == "auto" else Path(setting).expanduser()
    return PriorCache(folder / digest_of(rgb))


def digest_of(images: UInt8[Tensor, "t h w *c"]) -> str:
    """A digest of images and their size."""
    pixels = np.ascontiguousarray(images.cpu().numpy())
    return _digest(str(pixels.shape).encode(), pixels.data)


def _read(path: Path) -> Arrays | None:
    """The arrays of a file; None if there is none, or it is damaged."""
    if not path.is_file():
        return None
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        logger.warning("%s is damaged (%s): computed again", path, type(error).__name__)
        return None


def save_npz(path: Path, arrays: Arrays) -> None:
    """Write an npz file beside its place and rename it, so that it is complete or absent."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _code_of(compute: Callable[[], Arrays]) -> str:
    """Changes whenever this package's priors do, or the file of a provider from elsewhere."""
    package = Path(__file__).parent
    file = getattr(sys.modules.get(compute.__module__), "__file__", None)
    if file is None or Path(file).is_relative_to(package):
        return code_digest(package)
    return code_digest(package) + digest_of_file(Path(file))


@functools.cache
def code_digest(folder: Path) -> str:
    """Changes whenever a module in a folder does."""
    return _digest(*(path.read_bytes() for path in sorted(folder.rglob("*.py"))))


def _digest(*parts: bytes | memoryview) -> str:
    total = hashlib.blake2b(digest_size=_DIGEST)
    for part in parts:
        total.update(part)
    return total.hexdigest()
