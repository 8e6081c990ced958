"""Small image patches about points: correlation, and registration (Lucas-Kanade), with per-pixel weights."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from lerobot_msdyn.priors.tracks import kernels

_PIXELS = kernels.SIDE**2
_NOISE_VARIANCE = 4.0  # grey levels², of a compressed video; keeps flat patches from correlating by their noise
_FLOW_STD_PX = 0.3  # how far the starting point is usually off; holds points where the texture does not
_MAX_MOVE_PX = 2.0  # a registration that leads farther than this has slipped
_ITERATIONS = 6
_GAIN = (0.6, 1.6)  # change of contrast that is followed


@dataclass
class Patches:
    """Patches of p = 81 grey values, less their weighted mean, and what registration to them needs."""

    values: Float32[ndarray, "n p"]
    weights: Float32[ndarray, "n p"]  # 1 on the point's own surface, else 0
    gradients: Float32[ndarray, "n p 2"]  # grey levels per px
    energy: Float32[ndarray, " n"]  # weighted variance

    def rows(self, index: ndarray) -> "Patches":
        """Some of the patches, copied."""
        return Patches(self.values[index], self.weights[index], self.gradients[index], self.energy[index])

    def joined(self, other: "Patches") -> "Patches":
        """Both sets, this one first."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Patches(*(np.concatenate(pair) for pair in pairs))

    def replace(self, index: ndarray, others: "Patches") -> None:
        """Overwrite some of the patches."""
        for name, values in vars(others).items():
            vars(self)[name][index] = values

    def correlation(self, grey: Float32[ndarray, "h w"], xy: Float32[ndarray, "n 2"]) -> Float32[ndarray, " n"]:
        """Weighted normalised cross-correlation with an image at some positions; two flat patches are alike."""
        found = np.empty(len(xy), np.float32)
        kernels.correlations(grey, xy, self.values, self.weights, self.energy, _NOISE_VARIANCE, found)
        return found


def cut(grey: Float32[ndarray, "h w"], labels: UInt8[ndarray, "h w"], xy: Float32[ndarray, "n 2"]) -> Patches:
    """Patches about points; pixels of another label than the point's have weight 0."""
    patches = Patches(
        *(np.empty((len(xy), *shape), np.float32) for shape in ((_PIXELS,), (_PIXELS,), (_PIXELS, 2), ()))
    )
    kernels.cut(grey, labels, xy, patches.values, patches.weights, patches.gradients, patches.energy)
    return patches


def register(
    patches: Patches, grey: Float32[ndarray, "h w"], start: Float32[ndarray, "n 2"]
) -> tuple[Float32[ndarray, "n 2"], Float32[ndarray, " n"]]:
    """Positions at which an image looks most like the patches, near where they are expected; and the correlation.

    Inverse compositional Lucas-Kanade (Baker and Matthews 2004) for a translation, with contrast and brightness
    taken out, and with a prior that holds the point at its start along directions without texture. A registration that
    slips, or does not correlate better, is undone.
    """
    xy, ncc = np.empty_like(start), np.empty(len(start), np.float32)
    kernels.registered(
        grey,
        start,
        patches.values,
        patches.weights,
        patches.gradients,
        patches.energy,
        _NOISE_VARIANCE,
        _NOISE_VARIANCE / _FLOW_STD_PX**2,
        _ITERATIONS,
        _MAX_MOVE_PX,
        *_GAIN,
        xy,
        ncc,
    )
    return xy, ncc


def sample(image: ndarray, xy: Float32[ndarray, "n 2"]) -> Float32[ndarray, "n c"]:
    """Bilinear values of an image [h,w,c] at pixel positions."""
    if len(xy) == 0:
        return np.zeros((0, image.shape[2]), np.float32)
    x, y = np.ascontiguousarray((xy - 0.5).T)
    values = cv2.remap(image, x[:, None], y[:, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.reshape(len(xy), -1)
