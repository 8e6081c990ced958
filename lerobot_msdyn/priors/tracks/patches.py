"""Small image patches about points: correlation, and registration (Lucas-Kanade), with per-pixel weights."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

SIDE = 9  # px
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
        return self._compare(self._look(grey, xy))[0]

    def _look(self, grey: Float32[ndarray, "h w"], xy: Float32[ndarray, "n 2"]) -> Float32[ndarray, "n p"]:
        values = _values(grey, xy)
        return values - (_dot(self.weights, values) / self.weights.sum(1))[:, None]

    def _compare(self, values: Float32[ndarray, "n p"]) -> tuple[Float32[ndarray, " n"], Float32[ndarray, " n"]]:
        """Correlation with other patches less their means, and the other's contrast relative to this one's."""
        total = self.weights.sum(1)
        weighted = self.weights * values
        covariance = _dot(weighted, self.values) / total + _NOISE_VARIANCE
        energy, reference = _dot(weighted, values) / total + _NOISE_VARIANCE, self.energy + _NOISE_VARIANCE
        return covariance / np.sqrt(energy * reference), np.sqrt(energy / reference)


def cut(grey: Float32[ndarray, "h w"], labels: UInt8[ndarray, "h w"], xy: Float32[ndarray, "n 2"]) -> Patches:
    """Patches about points; pixels of another label than the point's have weight 0."""
    values = _values(grey, xy)
    around = _values(labels, xy, nearest=True)
    weights = (around == around[:, around.shape[1] // 2, None]).astype(np.float32)
    total = weights.sum(1)
    values = values - ((weights * values).sum(1) / total)[:, None]
    right, down = np.array([0.5, 0], np.float32), np.array([0, 0.5], np.float32)
    dx = (_values(grey, xy + right) - _values(grey, xy - right))[..., None]
    dy = (_values(grey, xy + down) - _values(grey, xy - down))[..., None]
    energy = (weights * values * values).sum(1) / total
    return Patches(values, weights, np.concatenate((dx, dy), axis=2), energy)


def register(
    patches: Patches, grey: Float32[ndarray, "h w"], start: Float32[ndarray, "n 2"]
) -> tuple[Float32[ndarray, "n 2"], Float32[ndarray, " n"]]:
    """Positions at which an image looks most like the patches, near where they are expected; and the correlation.

    Inverse compositional Lucas-Kanade (Baker and Matthews 2004) for a translation, with contrast and brightness
    taken out, and with a prior that holds the point at its start along directions without texture. A registration that
    slips, or does not correlate better, is undone.
    """
    prior = _NOISE_VARIANCE / _FLOW_STD_PX**2
    weighted = patches.weights[..., None] * patches.gradients
    across = np.ascontiguousarray(weighted.transpose(0, 2, 1))
    hessian = across @ patches.gradients + prior * np.eye(2, dtype=np.float32)
    inverse = np.linalg.inv(hessian)
    xy = start.copy()
    for _ in range(_ITERATIONS):
        values = patches._look(grey, xy)
        gain = patches._compare(values)[1].clip(*_GAIN)[:, None]
        error = (across @ (values / gain - patches.values)[..., None])[..., 0] + prior * (xy - start)
        xy = xy - (inverse @ error[..., None])[..., 0]
    moved = np.linalg.norm(xy - start, axis=1)
    xy = np.where((moved < _MAX_MOVE_PX)[:, None], xy, start)
    before, after = patches.correlation(grey, start), patches.correlation(grey, xy)
    better = after >= before
    return np.where(better[:, None], xy, start), np.where(better, after, before)


def _dot(a: Float32[ndarray, "n p"], b: Float32[ndarray, "n p"]) -> Float32[ndarray, " n"]:
    return np.einsum("np,np->n", a, b)


def sample(image: ndarray, xy: Float32[ndarray, "n 2"]) -> Float32[ndarray, "n c"]:
    """Bilinear values of an image [h,w,c] at pixel positions."""
    if len(xy) == 0:
        return np.zeros((0, image.shape[2]), np.float32)
    x, y = np.ascontiguousarray((xy - 0.5).T)
    values = cv2.remap(image, x[:, None], y[:, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.reshape(len(xy), -1)


def _values(image: ndarray, xy: Float32[ndarray, "n 2"], *, nearest: bool = False) -> Float32[ndarray, "n p"]:
    """Square windows about sub-pixel positions, one row each."""
    if len(xy) == 0:
        return np.zeros((0, SIDE * SIDE), np.float32)
    offset = np.arange(SIDE, dtype=np.float32) - SIDE // 2
    dy, dx = np.meshgrid(offset, offset, indexing="ij")
    centre = xy - np.float32(0.5)
    how = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    values = cv2.remap(
        image.astype(np.float32),
        centre[:, :1] + dx.reshape(1, -1),
        centre[:, 1:] + dy.reshape(1, -1),
        how,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return values.reshape(len(xy), SIDE * SIDE)
