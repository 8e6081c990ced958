"""What tasks are told, in a file of plain values that any node reads, and where each finds what they share.

<logs>/
  job.json                what is to be made
  result.json             how it went, once it is made
  background/             datatrove's folder of this step: logs, stats and completions, by rank
  episodes_64/            of 64 tasks
  merge/
  .../errors/00003.json   why a task ended without being done
"""

import json
import os
import shutil
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import draccus
import fsspec

from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.cluster.store import Store
from lerobot_msdyn.core.plugins import import_plugins
from lerobot_msdyn.dataset.staging import work_folder

JOB, RESULT, ERRORS = "job.json", "result.json", "errors"


@dataclass(frozen=True)
class Job:
    """What is to be made, by which settings. Plain values only: they are read before any plugin is imported."""

    plugins: list[str]
    settings: dict[str, Any]  # those of `AugmentConfig`, with absolute folders
    new_repo_id: str
    new_root: str
    folder: str  # the current one where the command was given, from which files are named
    logs: str  # folder or URL
    store: str  # URL of an object store; empty: all see the folder beside the output
    tasks: int
    processes: int  # of a task, that work on episodes at once
    threads: int  # of a task

    def write(self) -> None:
        """Write it to the folder of logs."""
        write_json(f"{self.logs}/{JOB}", asdict(self))

    @property
    def file(self) -> str:
        """Where `write` puts it."""
        return f"{self.logs}/{JOB}"

    def config(self) -> AugmentConfig:
        """The settings; plugins are imported, and files found where the command found them."""
        if os.path.isdir(self.folder):
            os.chdir(self.folder)
        import_plugins(self.plugins)
        config: AugmentConfig = draccus.decode(AugmentConfig, self.settings)
        config.workers = self.processes
        return config

    def place(self, task: str) -> "Place":
        """Where a task of this name finds and leaves what tasks share."""
        if not self.store:
            return Place(Path(self.new_root), None)
        name = Path(self.new_root).name
        new_root = Path(tempfile.gettempdir()) / "lerobot_msdyn" / name / task / name
        new_root.parent.mkdir(parents=True, exist_ok=True)
        return Place(new_root, Store(self.store))


@dataclass(frozen=True)
class Place:
    """The output's folder as a task sees it, and the store that holds its work folder, if one does."""

    new_root: Path
    store: Store | None

    @property
    def folder(self) -> Path:
        """The work folder."""
        return work_folder(self.new_root)

    def pull(self, *names: str) -> None:
        """Have what others have left in the store."""
        if self.store is not None:
            for name in names:
                self.store.get(name, self.folder)

    def push(self, *names: str, last: str = "") -> None:
        """Let others have what lies in the work folder; of a folder, the file `last` at the end."""
        if self.store is not None:
            for name in names:
                if (self.folder / name).exists():
                    self.store.put(self.folder / name, name, last)

    def forget(self, name: str) -> None:
        """Remove what the store has as well."""
        if self.store is not None:
            shutil.rmtree(self.folder / name, ignore_errors=True)


def read_job(file: str) -> Job:
    """The job that `Job.write` wrote."""
    return Job(**read_json(file))


def write_json(file: str, content: Any) -> None:
    """Write a file of a folder or URL."""
    with fsspec.open(file, "w", auto_mkdir=True) as stream:
        json.dump(content, stream, indent=1)


def read_json(file: str) -> Any:
    """The content of a file of a folder or URL."""
    with fsspec.open(file, "r") as stream:
        return json.load(stream)


def say_error(logs: str, rank: int, message: str) -> None:
    """Leave why a task ended without being done; empty: it was done."""
    write_json(f"{logs}/{ERRORS}/{rank:05d}.json", message)


def errors_in(logs: str) -> dict[int, str]:
    """What tasks of a step left, by rank."""
    files = fsspec.open_files(f"{logs}/{ERRORS}/*.json", "r")
    errors = {}
    for file in files:
        with file as stream:
            errors[int(Path(file.path).stem)] = str(json.load(stream))
    return {rank: message for rank, message in sorted(errors.items()) if message}
