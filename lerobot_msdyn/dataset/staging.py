"""The work folder of a run: what is finished is kept, so that a run that was stopped goes on where it was.

    .<output>.partial/
      lock                        held while a run works here
      run.json                    what is made, from what: recipe, digests of the source's files, versions
      backgrounds.safetensors     what the episodes of a camera show together
      shared.safetensors          what tasks of a cluster are told: episodes, cameras, and what their first node had
      calibration/                where cameras stand, by the robot's joints
      episodes/000003/
        lock                        held while a process works on the episode
        failed.json                 why it was left out, where a cluster's task could not make it
        copied.safetensors        the source's own pictures: files (in copied/) and statistics
        scene_<camera>.safetensors    a fitted scene
        variant_00.safetensors    one new episode: files (in variant_00/), statistics, provenance
        finished.safetensors      all new episodes of this one; the scenes are removed
      converted/                  the source, where it had to be converted
      dataset/                    the dataset as it is put together, always anew
      replaced/                   an older state of the output, while a newer one takes its place
      published.json              written right before the dataset is moved to its place

Every file is complete or absent. A value is read back from its file also in the run that made it, so that a run that
was stopped computes with the same bits as one that was not.
"""

import contextlib
import hashlib
import json
import logging
import os
import shutil
import socket
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from lerobot_msdyn.core.errors import OutputError, WorkerError
from lerobot_msdyn.core.files import DIGEST_BYTES, write_whole, writing
from lerobot_msdyn.core.serialise import ValueFileError, load_value, save_value

logger = logging.getLogger(__name__)

FINISHED = "finished"
SCENE = "scene"
LOCK, FAILED = "lock", "failed.json"  # of an episode
RUN, PUBLISHED = "run.json", "published.json"
REPLACED = "replaced"
BACKGROUNDS = "backgrounds"
SHARED = "shared"
CONVERTED = "converted"
WORTH_KEEPING = (SCENE, "variant", FINISHED)  # what takes long to make of an episode
STOPPED = (KeyboardInterrupt, OutputError, WorkerError)  # ends of a run that the same command can go on from
MAX_NAMED = 5  # differences that a message lists
CODE_CHANGED = "the code of lerobot_msdyn has changed"
FILES = ("source", "scenes", "files", "plugins")  # parts of the description whose values are digests of files


def work_folder(root: Path) -> Path:
    """Where the dataset that will lie in `root` is prepared."""
    return root.with_name(f".{root.name}.partial")


class Kept:
    """A folder of values that are computed once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def keep(self, name: str, make: Callable[[], Any]) -> Any:
        """The value of this name: from its file, else from `make`, which is then kept.

        A value is any that `save_value` can write. Files that it names must lie in this folder.

        Raises:
            OutputError: it cannot be written.
        """
        path = self._path(name)
        if path.exists():
            try:
                return load_value(path, self.folder)
            except ValueFileError as error:
                logger.warning("%s; it is made again", error)
        value = make()
        with writing(path):
            save_value(path, value, self.folder)
        return load_value(path, self.folder)

    def kept_value(self, name: str) -> Any:
        """The value of this name, which is there.

        Raises:
            OutputError: it is absent or damaged; it is removed, so that it is made again.
        """
        path = self._path(name)
        try:
            return load_value(path, self.folder)
        except ValueFileError as error:
            path.unlink(missing_ok=True)
            raise OutputError(f"{error}; give the same command again to make it anew") from error

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Within, no other process that asks for it works on what is kept here; waits until that is so.

        Raises:
            OutputError: the folder cannot be written.
        """
        lock = FileLock(self.folder / LOCK)
        with writing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            try:
                lock.acquire(timeout=0)
            except Timeout:
                logger.info("%s: another process works on it; waiting for it", self.folder)
                lock.acquire()
        try:
            yield
        finally:
            lock.release()

    def say_failed(self, reason: str) -> None:
        """Note why nothing could be made here; empty: it could."""
        if reason:
            write_whole(self.folder / FAILED, json.dumps(reason).encode())
        else:
            (self.folder / FAILED).unlink(missing_ok=True)

    def failed(self) -> str:
        """What `say_failed` noted; empty where it noted nothing."""
        try:
            return str(json.loads((self.folder / FAILED).read_text()))
        except (OSError, ValueError):
            return ""

    def has(self, name: str) -> bool:
        """Whether the value is there."""
        return self._path(name).exists()

    def forget(self, kind: str) -> None:
        """Remove the values whose names begin with `kind`."""
        for path in self.folder.glob(f"{kind}_*.safetensors"):
            path.unlink()

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.safetensors"


class Staging(Kept):
    """The work folder of one output, locked. Use as a context; leaving it keeps what is there."""

    def __init__(self, root: Path, *, lock: bool = True) -> None:
        """Make and lock the folder.

        Args:
            root: the place of the output.
            lock: false in a process that works for the one that holds the lock.

        Raises:
            OutputError: another run holds it, or it cannot be written.
        """
        super().__init__(work_folder(root))
        if not lock:
            return
        owner = self.folder / "owner"
        self._lock = FileLock(self.folder / "lock")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock.acquire(timeout=0)
            owner.write_text(f"process {os.getpid()} on {socket.gethostname()}")
        except Timeout as error:
            who = owner.read_text() if owner.exists() else "another process"
            raise OutputError(
                f"{root} is being written by {who}; wait for it, or choose another --new_repo_id or --new_root"
            ) from error
        except OSError as error:
            raise OutputError(
                f"{self.folder} cannot be written ({error.strerror}); choose another --new_root"
            ) from error

    def __enter__(self) -> "Staging":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(stopped=kind is not None and issubclass(kind, STOPPED))

    def close(self, *, stopped: bool = False) -> None:
        """Unlock the folder; it goes if nothing in it is worth keeping.

        Args:
            stopped: whether the run may go on, so that what its episodes share is worth keeping as well.
        """
        if not (self._episodes(*WORTH_KEEPING) or (stopped and self._shared())):
            self.remove()
        self._lock.release()

    def kept(self) -> str:
        """What is there for a run that goes on, in words; empty if nothing is."""
        finished, begun = self._episodes(FINISHED), self._episodes(*WORTH_KEEPING)
        parts = [f"{len(finished)} finished episodes"] if finished else []
        parts += [f"parts of {len(begun - finished)} more"] if begun - finished else []
        return ", ".join([*parts, *self._shared()])

    def _episodes(self, *names: str) -> set[str]:
        """The folders of episodes of which some of these values are kept."""
        folder = self.folder / "episodes"
        return {path.parent.name for name in names for path in folder.glob(f"*/{name}*.safetensors")}

    def _shared(self) -> list[str]:
        """What is kept of what all episodes share."""
        parts = ["the converted copy"] if (self.folder / CONVERTED).exists() else []
        return parts + (["the shared background"] if self.has(BACKGROUNDS) else [])

    def episode(self, index: int) -> Kept:
        """What is kept of one source episode."""
        return Kept(self.folder / "episodes" / f"{index:06d}")

    def finished(self) -> int:
        """How many episodes are finished."""
        return len(self._episodes(FINISHED))

    def agree(self, run: dict[str, Any], *, restart: bool = False) -> None:
        """Go on with what is here if it is the same run, else begin anew where nothing is, or on request.

        Args:
            run: what the result depends on, as JSON.
            restart: whether what is here is thrown away.

        Raises:
            OutputError: what is here belongs to another run; what differs is named.
        """
        path = self.folder / RUN
        if restart:
            self.clear()
        if path.exists():
            before = self._read(path)
            changes = differences(before, run)
            if changes:
                raise OutputError(f"{self.folder} holds an unfinished run that {_how_to_go_on(changes)}")
            logger.info("continuing the unfinished run in %s: %d episodes are done", self.folder, self.finished())
            return
        self.clear()
        with writing(path):
            write_whole(path, json.dumps(run, indent=1, sort_keys=True).encode())

    def publish(self, folder: Path, root: Path, skipped: Sequence[str], *, keep: bool = False) -> None:
        """Move a finished dataset to its place, in which an older state of it may lie, and remove this folder.

        With `keep` this folder stays, for a run that makes what was skipped.
        """
        if root.exists():
            shutil.rmtree(self.folder / REPLACED, ignore_errors=True)
            root.rename(self.folder / REPLACED)
        if keep:
            folder.rename(root)
            shutil.rmtree(self.folder / REPLACED, ignore_errors=True)
            return
        write_whole(self.folder / PUBLISHED, json.dumps(list(skipped)).encode())
        folder.rename(root)
        self.remove()

    def run_digest(self) -> str:
        """`digest_of_run` of the run that works here; empty where none was agreed on."""
        path = self.folder / RUN
        return digest_of_run(self._read(path)) if path.exists() else ""

    def _read(self, path: Path) -> Any:
        try:
            return json.loads(path.read_text())
        except (OSError, ValueError):
            return {}

    def clear(self) -> None:
        """Remove everything but the lock."""
        for path in self.folder.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name not in ("lock", "owner"):
                path.unlink()

    def remove(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def published_before(root: Path) -> list[str] | None:
    """What a run skipped that moved its dataset to `root` and was stopped right then; what it left is removed.

    None where that is not so.
    """
    path = work_folder(root) / PUBLISHED
    if not os.path.exists(root) or not path.exists() or (path.parent / "dataset").exists():
        return None
    with Staging(root) as staging:
        skipped = json.loads(path.read_text())
        staging.remove()
    return [str(line) for line in skipped]


def digest_of_run(run: dict[str, Any]) -> str:
    """A digest of what a result depends on (see `Staging.agree`), which shows nothing of the user's folders."""
    content = json.dumps(run, indent=1, sort_keys=True).encode()
    return hashlib.blake2b(content, digest_size=DIGEST_BYTES).hexdigest()


def _how_to_go_on(changes: list[str]) -> str:
    """What to do about a run that differs from the one that was begun."""
    more = f", and {len(changes) - MAX_NAMED} more" if len(changes) > MAX_NAMED else ""
    listed = "; ".join(sorted(changes, key=lambda change: change != CODE_CHANGED)[:MAX_NAMED])
    anew = "add --restart to throw away what it holds and begin anew, or choose another --new_repo_id"
    if changes == [CODE_CHANGED]:
        return (
            "another version of lerobot_msdyn began: the package's code has changed since, and one dataset must not "
            f"hold the results of both. Go on with the version that began it, {anew}"
        )
    code = ", with the version of lerobot_msdyn that began it" if CODE_CHANGED in changes else ""
    return f"was started differently: {listed}{more}. Start it as before{code} to go on, {anew}"


def differences(before: Any, now: Any, name: str = "") -> list[str]:
    """One line per value that differs between two nested dictionaries: its dotted name, the old and the new value."""
    if isinstance(before, dict) and isinstance(now, dict):
        lines = []
        for key in sorted({*before, *now}):
            inner = f"{name}: {key}" if name in FILES else f"{name}.{key}".removeprefix(".").removeprefix("recipe.")
            lines += differences(before.get(key), now.get(key), inner)
        return lines
    if before == now:
        return []
    if name == "versions.code":  # a digest, which says nothing to a reader
        return [CODE_CHANGED]
    if name.partition(": ")[0] in FILES:
        state = "is new" if before is None else "is gone" if now in (None, "absent") else "has changed"
        return [f"{name} {state}"]
    return [f"{name} was {before}, is {now}"]
