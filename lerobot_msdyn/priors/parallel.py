"""Work on one frame after the other, on all cores: OpenCV and NumPy let other threads run while they compute."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor


def on_all_cores[A, B](function: Callable[[A], B], items: Iterable[A]) -> list[B]:
    """What a function without side effects makes of each item, in their order."""
    with ThreadPoolExecutor(os.cpu_count() or 1, "frames") as pool:
        return list(pool.map(function, items))
