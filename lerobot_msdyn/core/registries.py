"""The registries that settings name: no torch here, so that names can be listed and checked at once."""

from collections.abc import Callable
from typing import Any

from lerobot_msdyn.core.registry import Registry

# reconstruction.loss_terms.LossTerm
LOSSES: Registry[Callable[[Any], Any]] = Registry("loss term", "lerobot_msdyn.reconstruction.losses")
