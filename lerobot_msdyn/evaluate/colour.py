"""Colours of one camera as another one shows them: exposure and white balance differ between cameras.

A gain and an offset per channel that give the rendered pixels the mean and the spread of the true ones. Least squares
would flatter: the less a picture agrees with the true one, the flatter it would be made, and flat pictures score well.
Mean and spread do not ask which pixel belongs to which.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from lerobot_msdyn.evaluate.metrics import LEVELS, quantised


@dataclass(frozen=True)
class ColourMap:
    """Per channel, of colours 0..1: gain times the value, plus an offset."""

    gain: Float[ndarray, "3"]
    offset: Float[ndarray, "3"]

    def apply(self, pictures: UInt8[ndarray, "n h w 3"]) -> UInt8[ndarray, "n h w 3"]:
        """Pictures in the other camera's colours."""
        return np.stack([quantised(picture / LEVELS * self.gain + self.offset + 0.5 / LEVELS) for picture in pictures])


def fit_colours(
    rendered: UInt8[ndarray, "n h w 3"], true: UInt8[ndarray, "n h w 3"], masks: Bool[ndarray, "n h w"]
) -> ColourMap:
    """The map from the rendered to the true pixels inside the masks; the identity where these hold nothing."""
    if not masks.any():
        return ColourMap(np.ones(3), np.zeros(3))
    a, b = rendered[masks] / LEVELS, true[masks] / LEVELS
    gain = b.std(0) / np.maximum(a.std(0), 1 / LEVELS)
    return ColourMap(gain, b.mean(0) - gain * a.mean(0))
