"""A loss term of your own: Gaussians that are much longer than wide are made rounder.

python -m lerobot_msdyn.augment --repo local/ds --plugins examples/plugins/own_loss.py --fit.weights.slender 0.01

In a package of your own, an entry point does the same without a flag:

    [project.entry-points."lerobot_msdyn.reconstruction.losses"]
    slender = "my_package.losses:slender"
"""

import math

from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.registries import LOSSES
from lerobot_msdyn.reconstruction.loss_terms import FitStep

LONGEST = 3.0  # times the second longest axis, beyond which a Gaussian is penalised


@LOSSES.register("slender")
def slender(step: FitStep) -> Float[Tensor, ""]:
    """Mean logarithm by which the longest axis of a moving Gaussian exceeds `LONGEST` times the next."""
    longest, second, _ = step.scene.moving.scales.log().sort(dim=-1, descending=True).values.unbind(-1)
    excess = (longest - second - math.log(LONGEST)).clamp(min=0)
    return excess.sum() / max(len(excess), 1)
