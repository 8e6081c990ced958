"""`orbit` with its amounts drawn towards the ends of their range (arcsine distribution): --plugins of one row."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from lerobot_msdyn.core.perturbation import Perturbation
from lerobot_msdyn.views.perturbations.orbit import Orbit


@Perturbation.register_subclass("ends")
@dataclass
class Ends(Orbit):
    """Half of all amounts lie beyond 0.71 of the range."""

    def shares(
        self, uniform: Float32[ndarray, "t n"], phases: Float32[ndarray, "t n"], frames: int
    ) -> Float32[ndarray, "s n"]:
        """The sine of a uniform angle."""
        return np.sin(math.pi * (uniform - np.float32(0.5)))
