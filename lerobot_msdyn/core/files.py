"""Files that are complete or absent, digests of files, and disks that are full or closed."""

import contextlib
import errno
import hashlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from lerobot_msdyn.core.errors import DatasetError, OutputError

DISK_FAULTS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG}
BLOCK_BYTES = 1 << 20
CACHE_VARIABLE = "LEROBOT_MSDYN_CACHE"
DIGEST_BYTES = 16


def check_root(root: Path) -> None:
    """Whether a folder can be that of a LeRobot dataset.

    Raises:
        DatasetError: its first file is absent.
    """
    if not (root / "meta" / "info.json").exists():
        raise DatasetError(
            f"no dataset in {root}: {root / 'meta' / 'info.json'} is absent; "
            "--root is the exact folder that holds meta/, data/ and videos/"
        )


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A place beside `path` to write to; what lies there afterwards takes its name by one rename."""
    part = path.with_name(f".{path.stem}.part{path.suffix}")  # FFmpeg goes by the suffix
    try:
        yield part
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that is complete or absent; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part:
        part.write_bytes(content)


@contextlib.contextmanager
def writing(place: Path) -> Iterator[None]:
    """What goes wrong while something is written to `place` is the disk's fault and ends the run.

    Raises:
        OutputError: the disk is full, read-only, too slow, or gone.
    """
    try:
        yield
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise OutputError(
            f"{place} cannot be written ({reason}); what is finished is kept: make room there (or choose another "
            "--new_root) and give the same command again"
        ) from error


@contextlib.contextmanager
def temporary_files_in(folder: Path) -> Iterator[None]:
    """Libraries put their temporary files under `folder`, so that none stays elsewhere when a run is killed."""
    before, tempfile.tempdir = tempfile.tempdir, str(folder / "temporary")
    Path(tempfile.tempdir).mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        tempfile.tempdir = before


def cache_folder(stage: str) -> Path:
    """LEROBOT_MSDYN_CACHE if it is set, else the stage's folder in lerobot_msdyn/ of the user's cache folder."""
    if os.environ.get(CACHE_VARIABLE):
        return Path(os.environ[CACHE_VARIABLE]).expanduser()
    home = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(home).expanduser() / "lerobot_msdyn" / stage


def digest_of_file(path: Path) -> str:
    """A digest of a file's content; "absent" where there is none, or it cannot be read."""
    total = hashlib.blake2b(digest_size=DIGEST_BYTES)
    try:
        if not path.is_file():  # a pipe would be waited for
            return "absent"
        with path.open("rb") as file:
            while block := file.read(BLOCK_BYTES):
                total.update(block)
    except OSError:
        return "absent"
    return total.hexdigest()
