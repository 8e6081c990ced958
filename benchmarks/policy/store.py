"""What survives when the study is stopped: every finished piece of work is a file or folder of its own."""

import json
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lerobot_msdyn.core.files import write_whole


class Store:
    """A folder of finished pieces; what is there is not made again."""

    def __init__(self, root: Path, settings: dict[str, Any]) -> None:
        """A folder that is new or holds pieces of the same settings; else the process ends with one line."""
        self.root = root
        plain = json.loads(json.dumps(settings))
        path = root / "settings.json"
        if path.exists() and json.loads(path.read_text()) != plain:
            before = json.loads(path.read_text())
            changed = sorted(name for name in before.keys() | plain.keys() if before.get(name) != plain.get(name))
            sys.exit(f"{root} holds a study of other settings ({', '.join(changed)}); choose another --out")
        write_whole(path, (json.dumps(plain, indent=1) + "\n").encode())

    def json(self, name: str, make: Callable[[], Any]) -> Any:
        """What `name`.json holds, made and written if it is not there."""
        path = self.root / f"{name}.json"
        if not path.exists():
            value = self._timed(name, make)
            write_whole(path, json.dumps(value).encode())
        return json.loads(path.read_text())

    def made(self, name: str, make: Callable[[Path], None]) -> Path:
        """A file or folder that `make` writes to the path that it is given."""
        path = self.root / name
        if not path.exists():
            part = path.with_name(f".{path.stem}.part{path.suffix}")
            if part.is_dir():
                shutil.rmtree(part)
            part.parent.mkdir(parents=True, exist_ok=True)
            self._timed(name, lambda: make(part))
            part.replace(path)
        return path

    def _timed(self, name: str, make: Callable[[], Any]) -> Any:
        begin, cpu = time.perf_counter(), cpu_seconds()
        value = make()
        seconds = {"wall_s": round(time.perf_counter() - begin, 1), "cpu_s": round(cpu_seconds() - cpu, 1)}
        with (self.root / "time.jsonl").open("a") as file:
            file.write(json.dumps({"piece": name} | seconds) + "\n")
        print(f"{name}: {seconds['wall_s']:.0f} s ({seconds['cpu_s']:.0f} s of processor time)", flush=True)
        return value


def cpu_seconds() -> float:
    """Processor time of this process and of those it has waited for."""
    import resource

    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
