"""How long each stage of an evaluation takes."""

import contextlib
import time
from collections.abc import Iterator, Sequence

from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.reconstruction.reconstruct import reconstruct
from lerobot_msdyn.reconstruction.result import Reconstruction


@contextlib.contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Adds the time (s) that the block takes to that of a stage."""
    start = time.perf_counter()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start


def timed_reconstruction(
    seconds: dict[str, float], view: View, recipe: Recipe, *, others: Sequence[View] = ()
) -> Reconstruction:
    """A reconstructed view; its time (s) is told apart into what comes before the fit, and the fit."""
    start = time.perf_counter()
    scene = reconstruct(view, recipe, others=others)
    seconds["priors and initialisation"] = time.perf_counter() - start - scene.seconds["fit"]
    seconds["fit"] = scene.seconds["fit"]
    return scene
