"""The robot told from other things that move, once it is roughly known where it is in each frame."""

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8
from numpy import ndarray

from lerobot_msdyn.core.images import masked_median
from lerobot_msdyn.priors.masks.change import Colours, Reference, along_edges, to_lab

_LEAST_EMPTY = 4  # frames in which a pixel is seen without the robot, for its background to be known
_NOISE_FLOOR = 1.0  # CIE Lab units
_SURE = 3.0


class RobotPictures:
    """What pictures show of a robot that stands differently in each of them."""

    def __init__(self, pictures: UInt8[ndarray, "t h w 3"]) -> None:
        self._pictures = pictures

    def moving(self, frames: Int64[ndarray, " k"]) -> Bool[ndarray, "k h w"]:
        """What differs from the median."""
        empty = np.median(self._pictures, axis=0).astype(np.uint8)
        reference = Reference(empty, _noise(self._pictures[frames], empty))
        some = self._pictures[frames]
        return np.stack([along_edges(reference.change(picture), picture) > 0 for picture in some])

    def masks(
        self, robot: Bool[ndarray, "k h w"], frames: Int64[ndarray, " k"]
    ) -> tuple[Bool[ndarray, "k h w"], Bool[ndarray, "h w"]]:
        """What is the robot, by what is behind it and by its colours; and where that can be told.

        Args:
            robot: where it is about, slightly too large; beyond it nothing is the robot.
            frames: the pictures that are looked at.
        """
        some = self._pictures[frames]
        empty, known = _empty(some, robot)
        reference = Reference(empty, _noise(some, empty))
        changes = [np.where(known, reference.change(picture), 0).astype(np.float32) for picture in some]
        colours = Colours()
        for picture, near, change in zip(some, robot, changes, strict=True):
            colours.add(picture, np.where(near, change, -2 * _SURE).astype(np.float32), _SURE)
        odds = zip(some, changes, strict=True)
        masks = np.stack([along_edges(change + colours.odds(picture), picture) > 0 for picture, change in odds])
        return masks & robot, known

    def difference(self, robot: Bool[ndarray, "t h w"]) -> tuple[Float32[ndarray, "t h w"], Bool[ndarray, "h w"]]:
        """Distance of colours to those of the scene without the robot (CIE Lab units), and where it is known."""
        empty, known = _empty(self._pictures, robot)
        before = to_lab(empty)
        return np.stack([np.linalg.norm(to_lab(picture) - before, axis=-1) for picture in self._pictures]), known


def _empty(
    pictures: UInt8[ndarray, "t h w 3"], robot: Bool[ndarray, "t h w"]
) -> tuple[UInt8[ndarray, "h w 3"], Bool[ndarray, "h w"]]:
    """The scene without the robot, and where it is known."""
    known = (~robot).sum(0) >= _LEAST_EMPTY
    return masked_median(pictures, (~robot | ~known)[..., None]).astype(np.uint8), known


def _noise(frames: UInt8[ndarray, "t h w 3"], empty: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    reference = to_lab(empty)
    distance = np.stack([np.linalg.norm(to_lab(frame) - reference, axis=-1) for frame in frames])
    return np.median(distance, axis=0).clip(min=_NOISE_FLOOR).astype(np.float32)
