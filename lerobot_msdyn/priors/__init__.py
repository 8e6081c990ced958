"""What is known about a video before the fit: depth, what moves, point tracks and the camera.

The names are imported when they are first used, so that `python -m lerobot_msdyn.priors --help` answers at once.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lerobot_msdyn.core.observations import Origin, PointTracks, Priors
    from lerobot_msdyn.priors.estimate import estimate_masks, estimate_priors

__all__ = ["Origin", "PointTracks", "Priors", "estimate_masks", "estimate_priors"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = "priors.estimate" if name.startswith("estimate") else "core.observations"
    return getattr(importlib.import_module(f"lerobot_msdyn.{home}"), name)
