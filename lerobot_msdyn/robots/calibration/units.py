"""In which units the joints are, once cameras were looked for: those that need the least correction."""

from collections.abc import Sequence

import numpy as np

from lerobot_msdyn.robots.calibration.solve import GOOD_HITS, Verdict
from lerobot_msdyn.robots.mapping import JointMap

PER_CORRECTION = 0.5  # hits that a mean correction of the units weighs


def fit(verdict: Verdict) -> float:
    """Share of hits, less what the joints' units had to be corrected by."""
    return verdict.hits - PER_CORRECTION * float(np.abs(verdict.solution.scale - 1).mean())


def is_settled(mapping: JointMap, verdict: Verdict, others: Sequence[JointMap]) -> bool:
    """Whether a camera fits well by these units, and its corrections of them do not point to others."""
    scale = verdict.solution.scale
    known = (mapping.columns >= 0) & (mapping.scale != 0)
    own = float((np.log(scale[known]) ** 2).sum())
    off = (np.log(scale[known] * mapping.scale[known] / other.scale[known]) for other in others)
    return verdict.hits >= GOOD_HITS and all(own <= float((each**2).sum()) for each in off)
