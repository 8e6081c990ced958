"""The robot told from other things that move, once it is roughly known where it is in each frame."""

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

from lerobot_msdyn.core.images import masked_median
from lerobot_msdyn.priors.masks.change import Colours, Reference, along_edges, to_lab

_LEAST_EMPTY = 4  # frames in which a pixel is seen without the robot, for its background to be known
_NOISE_FLOOR = 1.0  # CIE Lab units
_SURE = 3.0


def first_masks(frames: UInt8[ndarray, "t h w 3"]) -> Bool[ndarray, "t h w"]:
    """What differs from the median of frames in which the robot stands differently."""
    empty = np.median(frames, axis=0).astype(np.uint8)
    reference = Reference(empty, _noise(frames, empty))
    return np.stack([along_edges(reference.change(frame), frame) > 0 for frame in frames])


class RobotMasks:
    """Sharpens masks of a robot by the empty scene behind it and by its colours."""

    def __init__(self, frames: UInt8[ndarray, "t h w 3"]) -> None:
        self._frames = frames

    def __call__(self, robot: Bool[ndarray, "t h w"]) -> tuple[Bool[ndarray, "t h w"], Bool[ndarray, "t h w"]]:
        """What is the robot, and where that can be told.

        Args:
            robot: where it is about, slightly too large.
        """
        frames = self._frames
        known = (~robot).sum(0) >= _LEAST_EMPTY
        empty = masked_median(frames, (~robot | ~known)[..., None]).astype(np.uint8)
        reference = Reference(empty, _noise(frames, empty))
        changes = [reference.change(frame) for frame in frames]
        colours = Colours()
        for frame, near, change in zip(frames, robot, changes, strict=True):
            sure = np.where(near, np.where(known, change, 0), -2 * _SURE).astype(np.float32)
            colours.add(frame, sure, _SURE)
        masks = np.stack(
            [
                along_edges(np.where(known, change, 0).astype(np.float32) + colours.odds(frame), frame) > 0
                for frame, change in zip(frames, changes, strict=True)
            ]
        )
        return masks, np.broadcast_to(known, masks.shape)


def _noise(frames: UInt8[ndarray, "t h w 3"], empty: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    reference = to_lab(empty)
    distance = np.stack([np.linalg.norm(to_lab(frame) - reference, axis=-1) for frame in frames])
    return np.median(distance, axis=0).clip(min=_NOISE_FLOOR).astype(np.float32)
