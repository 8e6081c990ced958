"""Levels of motion as what they are in a test: bases."""

from collections.abc import Iterable

from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.model.compose import Level


def of_bases(levels: Iterable[Level]) -> tuple[MotionLevel, ...]:
    """The same levels; each of them consists of bases, or the test fails."""
    found = []
    for level in levels:
        assert isinstance(level, MotionLevel)
        found.append(level)
    return tuple(found)
