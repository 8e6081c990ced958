"""Functions compiled by numba: one way to say so, which run-time checks of annotations do not get into."""

import inspect
from collections.abc import Callable
from typing import Any

import numba


def compiled(function: Callable, **options: Any) -> Any:
    """Compiles a function that Python calls; its machine code is kept on disk.

    numba notices changes of the function's own file only: after editing what it inlines from others, touch that file.
    """
    return _compiled(function, cache=True, **options)


def inlined(function: Callable, **options: Any) -> Any:
    """Compiles a function that compiled ones call: a real call would copy the descriptors of all arrays."""
    return _compiled(function, forceinline=True, **options)


def _compiled(function: Callable, **options: Any) -> Any:
    plain = inspect.unwrap(function)  # tests wrap annotated functions in checks, which cannot be compiled
    return numba.njit(**({"nogil": True, "error_model": "numpy"} | options))(plain)
