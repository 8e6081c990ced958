"""What settings choose from by name; no torch here, so that names can be listed and checked at once.

`priors/registry.py`, `motion/spec.py` and `reconstruction/loss_terms.py` say what is registered; perturbations have
their registry in `core/perturbation.py`, beside their base class.
"""

from collections.abc import Callable
from typing import Any

from lerobot_msdyn.core.registry import Registry

DEPTH: Registry[Any] = Registry("depth provider", "lerobot_msdyn.priors.depth.providers")
MASKS: Registry[Any] = Registry("mask provider", "lerobot_msdyn.priors.masks.providers")
TRACKS: Registry[Any] = Registry("track provider", "lerobot_msdyn.priors.tracks.providers")
CAMERAS: Registry[Any] = Registry("camera provider", "lerobot_msdyn.priors.camera.providers")
MOTION_LEVELS: Registry[Any] = Registry("motion level", "lerobot_msdyn.motion.levels")
LOSSES: Registry[Callable[[Any], Any]] = Registry("loss term", "lerobot_msdyn.reconstruction.losses")
