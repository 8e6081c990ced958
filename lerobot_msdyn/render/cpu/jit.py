"""How the kernels of the CPU rasterizer are compiled: when first called, once per installation, kept on disk."""

import hashlib
import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import event

from lerobot_msdyn.core.compiled import compiled, inlined

if numba.config.DISABLE_JIT:
    raise ImportError("numba's compiler is switched off (NUMBA_DISABLE_JIT)")

_log = logging.getLogger(__name__)

# Reassociation stays off: results must not depend on how a compiler regroups sums. NaN and Inf keep their meaning.
_OPTIONS = {
    "boundscheck": False,
    "fastmath": {"contract", "nsz", "arcp"},
}


def kernel(function: Callable) -> Any:
    """Compile a function that Python calls; its machine code is kept in numba's disk cache."""
    return compiled(function, **_OPTIONS)


def device(function: Callable) -> Any:
    """Compile a function that kernels call; it is always inlined."""
    return inlined(function, **_OPTIONS)


def source_fingerprint() -> str:
    """Hash of this folder's sources. numba's cache watches only the file of the kernel, not what it inlines."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


class _CompileNotice(event.Listener):
    """Logs one line when the first kernel of a process is compiled instead of loaded from the cache."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._told = False

    def on_start(self, event: event.Event) -> None:
        function = event.data["dispatcher"].py_func
        if function.__module__.rpartition(".")[0] != __name__.rpartition(".")[0]:
            return
        with self._lock:
            if self._told:
                return
            self._told = True
        _log.info(
            "compiling the CPU rasterizer: this happens once per installation and takes up to a minute "
            "(`python -m lerobot_msdyn.render.warmup` does it beforehand)"
        )

    def on_end(self, event: event.Event) -> None:
        """Nothing to do: the notice is given at the start."""


event.register("numba:compile", _CompileNotice())
