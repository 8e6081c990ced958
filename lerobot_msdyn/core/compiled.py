"""Functions compiled by numba: one way to say so, which run-time checks of annotations do not get into."""

import contextlib
import inspect
from collections.abc import Callable, Iterator
from typing import Any

import numba
from numba.core import event


def compiled(function: Callable, **options: Any) -> Any:
    """Compiles a function that Python calls; its machine code is kept on disk.

    numba notices changes of the function's own file only: after editing what it inlines from others, touch that file.
    """
    return _compiled(function, cache=True, **options)


def inlined(function: Callable, **options: Any) -> Any:
    """Compiles a function that compiled ones call: a real call would copy the descriptors of all arrays."""
    return _compiled(function, forceinline=True, **options)


@contextlib.contextmanager
def time_spent_compiling() -> Iterator[Callable[[], float]]:
    """Within, a function that says how many seconds have gone into compiling so far."""
    with event.install_listener("numba:compile", event.TimingListener()) as listener:
        yield lambda: listener.duration if listener.done else 0.0


def _compiled(function: Callable, **options: Any) -> Any:
    plain = inspect.unwrap(function)  # tests wrap annotated functions in checks, which cannot be compiled
    return numba.njit(**({"nogil": True, "error_model": "numpy"} | options))(plain)
