"""How strongly a pixel differs from an image of the empty scene, beyond noise and shadows."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8
from numpy import ndarray

from lerobot_msdyn.render.cpu.threads import in_threads

_NOISE_CEILING = 2.0  # times the image's median noise: a pixel that is often covered only looks noisy
_TEXTURE_WINDOW = 7  # px
_TEXTURE_NOISE = 2.0  # Lab units; flatter than this, a window has no texture
_DARK = 8.0  # grey levels, added to both sides of a ratio
_EVEN_WINDOW = 5  # px, over which the ratio of brightness should be even
_MOST = 6.0  # log-odds; no pixel is surer than this
# Log-odds of "another thing" against "the same, perhaps in the shadow", by logistic regression on true masks
# (benchmarks/tune_masks.py): weights of the features of `Reference.features`, in their order.
_WEIGHTS = (0.27, 1.05, 1.47, -2.33, 2.53, 0.27)
_BIAS = -1.78

_GUIDE_WINDOW = 9  # px
_GUIDE_NOISE = 60.0  # grey levels²; weaker edges of the picture do not hold the outline

_COLOUR_BINS = (12, 24, 24)  # of CIE Lab
_RARE = 1e-5  # share of a colour that was never met
_MOST_BY_COLOUR = 3.0  # log-odds

_LOGARITHM = np.log(np.arange(256, dtype=np.float32) + np.float32(_DARK))  # of grey levels


def to_lab(rgb: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w 3"]:
    """CIE Lab: lightness 0..100, colour about ±100."""
    return cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)


class Reference:
    """A picture of the empty scene, and the usual distance (CIE Lab units) of each pixel from it."""

    def __init__(self, picture: UInt8[ndarray, "h w 3"], noise: Float32[ndarray, "h w"]) -> None:
        self._lab, self._log = to_lab(picture), _LOGARITHM[picture]
        self._texture = _Texture(self._lab[..., 0])
        self._noise = np.minimum(noise, _NOISE_CEILING * np.median(noise))

    def change(self, frame: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
        """Log-odds, within ±6, that a pixel of a frame shows another thing.

        A shadow, or its end, scales all channels alike and evenly and leaves the texture as it is; where there is
        neither colour nor texture, a thing can be taken for a shadow.
        """
        odds = np.full(self._noise.shape, _BIAS, np.float32)
        for weight, feature in zip(_WEIGHTS, self.features(frame), strict=True):
            odds += np.float32(weight) * feature
        return odds.clip(-_MOST, _MOST)

    def features(self, frame: UInt8[ndarray, "h w 3"]) -> tuple[ndarray, ...]:
        """Unevenness of the ratio over the channels; change of colour beyond that of lightness; unevenness of the ratio
        over neighbours; correlation of texture; distance in noise levels; brightening.
        """
        lab, before = to_lab(frame), self._lab
        distance = _length(lab - before) / self._noise
        lightness = (lab[..., 0] + 1) / (before[..., 0] + 1)
        colour = _length(lab[..., 1:] - lightness[..., None] * before[..., 1:])
        ratio = _LOGARITHM[frame] - self._log
        r, g, b = (ratio[..., k] for k in range(3))
        mean = (r + g + b) / 3
        tint = np.maximum(np.maximum(np.maximum(r, g), b) - mean, mean - np.minimum(np.minimum(r, g), b))
        even = _mean(np.abs(mean - cv2.medianBlur(mean, _EVEN_WINDOW)), _EVEN_WINDOW)
        alike = self._texture.correlation(_Texture(lab[..., 0]))
        return np.log(tint + 0.02), np.log(colour + 1), np.log(even + 0.01), alike, np.log(distance + 1), mean.clip(0)


def changes(
    frames: UInt8[ndarray, "t h w 3"], reference: UInt8[ndarray, "h w 3"], noise: Float32[ndarray, "h w"]
) -> Bool[ndarray, "t h w"]:
    """Pixels of each frame that show something else than the reference does, neighbours deciding together."""
    before = Reference(reference, noise)
    return np.stack([*in_threads(lambda frame: along_edges(before.change(frame), frame) > 0, frames)])


class _Texture:
    """What two pictures' textures are compared by: means and variances in a window about every pixel."""

    def __init__(self, lightness: Float32[ndarray, "h w"]) -> None:
        self._values = np.ascontiguousarray(lightness)
        self._means = _mean(self._values, _TEXTURE_WINDOW)
        square = _mean(self._values * self._values, _TEXTURE_WINDOW)
        self._variance = (square - self._means * self._means).clip(0) + _TEXTURE_NOISE**2

    def correlation(self, other: "_Texture") -> Float32[ndarray, "h w"]:
        """Normalised cross-correlation; two flat windows correlate."""
        together = _mean(self._values * other._values, _TEXTURE_WINDOW)
        covariance = together - self._means * other._means + np.float32(_TEXTURE_NOISE**2)
        return covariance / np.sqrt(self._variance * other._variance)


def _mean(image: ndarray, side: int) -> ndarray:
    """Over a square window about every pixel."""
    return cv2.blur(image, (side, side))


def _length(vectors: Float32[ndarray, "h w c"]) -> Float32[ndarray, "h w"]:
    return np.sqrt(np.einsum("hwc,hwc->hw", vectors, vectors))


def along_edges(odds: Float32[ndarray, "h w"], frame: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    """Log-odds smoothed within the picture's edges: guided filter (He et al. 2013) with the colours as the guide."""
    guide = frame.astype(np.float32)
    guide_mean, odds_mean = _mean(guide, _GUIDE_WINDOW), _mean(odds, _GUIDE_WINDOW)
    pr, pg, pb = cv2.split(_mean(guide * odds[..., None], _GUIDE_WINDOW) - guide_mean * odds_mean[..., None])
    squares = _mean(guide * guide, _GUIDE_WINDOW) - guide_mean * guide_mean + np.float32(_GUIDE_NOISE)
    turned, turned_mean = guide[..., [1, 2, 0]], guide_mean[..., [1, 2, 0]]
    between = _mean(guide * turned, _GUIDE_WINDOW) - guide_mean * turned_mean
    (rr, gg, bb), (rg, gb, rb) = cv2.split(squares), cv2.split(between)
    # the inverse of the symmetric 3x3 covariance, by cofactors
    c_rr, c_rg, c_rb = gg * bb - gb * gb, rb * gb - rg * bb, rg * gb - rb * gg
    c_gg, c_gb, c_bb = rr * bb - rb * rb, rb * rg - rr * gb, rr * gg - rg * rg
    determinant = rr * c_rr + rg * c_rg + rb * c_rb
    slope = cv2.merge(
        (
            (c_rr * pr + c_rg * pg + c_rb * pb) / determinant,
            (c_rg * pr + c_gg * pg + c_gb * pb) / determinant,
            (c_rb * pr + c_gb * pg + c_bb * pb) / determinant,
        )
    )
    offset = odds_mean - np.einsum("hwc,hwc->hw", slope, guide_mean)
    smooth = np.einsum("hwc,hwc->hw", _mean(slope, _GUIDE_WINDOW), guide)
    return smooth + _mean(offset, _GUIDE_WINDOW)


class Colours:
    """Which colours things that move have, and which the empty scene: histograms of CIE Lab, filled frame by frame."""

    def __init__(self) -> None:
        self._counts = np.zeros((2, *_COLOUR_BINS), np.float64)
        self._odds: Float32[ndarray, " bins"] | None = None  # of each bin, once they are asked for

    def add(self, frame: UInt8[ndarray, "h w 3"], odds: Float32[ndarray, "h w"], sure: float) -> None:
        """Count the pixels whose log-odds of moving are beyond ± `sure`."""
        index = _bins(frame)
        for counts, chosen in zip(self._counts, (odds > sure, odds < -sure), strict=True):
            counts += np.bincount(index[chosen], minlength=counts.size).reshape(counts.shape)
        self._odds = None

    def odds(self, frame: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
        """Log-odds, within ±3, that a pixel belongs to something that moves, from its colour alone."""
        if self._odds is None:
            moving, empty = (_spread(counts / max(counts.sum(), 1)) for counts in self._counts)
            odds = np.log((moving + _RARE) / (empty + _RARE)).clip(-_MOST_BY_COLOUR, _MOST_BY_COLOUR)
            self._odds = odds.ravel().astype(np.float32)
        return self._odds[_bins(frame)]


def _bins(frame: UInt8[ndarray, "h w 3"]) -> Int[ndarray, "h w"]:
    lightness, a, b = cv2.split(cv2.cvtColor(frame, cv2.COLOR_RGB2LAB))  # 8 bit: lightness * 2.55, colour + 128
    positions = np.arange(256) / 255, (np.arange(256) - 48) / 160, (np.arange(256) - 48) / 160
    bins = [(s * n).astype(int).clip(0, n - 1) for s, n in zip(positions, _COLOUR_BINS, strict=True)]
    _, columns, depth = _COLOUR_BINS
    return (bins[0] * columns * depth)[lightness] + (bins[1] * depth)[a] + bins[2][b]


def _spread(shares: ndarray) -> ndarray:
    """A histogram with every bin shared among its neighbours (1/4, 1/2, 1/4 along each axis)."""
    for axis, size in enumerate(shares.shape):
        padded = np.pad(shares, [(1, 1) if k == axis else (0, 0) for k in range(shares.ndim)])
        before, at, after = (np.take(padded, np.arange(size) + shift, axis) for shift in range(3))
        shares = 0.25 * before + 0.5 * at + 0.25 * after
    return shares
