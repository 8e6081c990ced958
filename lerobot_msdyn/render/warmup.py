"""Compiles the CPU rasterizer beforehand: `python -m lerobot_msdyn.render.warmup [--channels N ...]`.

For images and continuous integration; without it, the first call compiles what it needs. Machine code is kept in
`__pycache__` next to the sources, in the user's cache folder where that cannot be written, or in NUMBA_CACHE_DIR.
"""

import argparse
import logging
import time
from collections.abc import Iterable

import torch

from lerobot_msdyn.core.errors import MsdynError
from lerobot_msdyn.render.backends import rasterize
from lerobot_msdyn.render.types import MAX_CPU_CHANNELS

_log = logging.getLogger(__name__)


def warm_up(channels: Iterable[int]) -> None:
    """Compile, or load from the cache, the kernels for these numbers of feature channels.

    Raises:
        RenderError: the CPU backend cannot be used here.
    """
    for count in channels:
        start = time.perf_counter()
        means = torch.tensor([[0.0, 0.0, 2.0]], requires_grad=True)
        intrinsics = torch.tensor([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])[None]
        quats, scales = torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1)
        opacities, features = torch.full((1,), 0.5), torch.ones(1, count)
        poses = torch.eye(4)[None]
        raster = rasterize(means, quats, scales, opacities, features, poses, intrinsics, 8, 8, backend="cpu")
        raster.depth.sum().backward()
        _log.info("%2d feature channels: ready after %.1f s", count, time.perf_counter() - start)


def main() -> None:
    """Command line of this module."""
    parser = argparse.ArgumentParser(prog="python -m lerobot_msdyn.render.warmup", description=__doc__)
    parser.add_argument(
        "--channels",
        type=int,
        nargs="+",
        default=range(1, MAX_CPU_CHANNELS + 1),
        help="numbers of feature channels to prepare (default: all that the backend takes)",
    )
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    logging.getLogger("numba").setLevel(logging.WARNING)
    try:
        warm_up(arguments.channels)
    except MsdynError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
