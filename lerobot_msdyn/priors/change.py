"""How strongly a pixel differs from an image of the empty scene, beyond noise and shadows."""

import cv2
import numpy as np
from jaxtyping import Float32, Int, UInt8
from numpy import ndarray

_NOISE_CEILING = 2.0  # times the image's median noise: a pixel that is often covered only looks noisy
_TEXTURE_WINDOW = 7  # px
_TEXTURE_NOISE = 2.0  # Lab units; flatter than this, a window has no texture
_DARK = 8.0  # grey levels, added to both sides of a ratio
_EVEN_WINDOW = 5  # px, over which the ratio of brightness should be even
_MOST = 6.0  # log-odds; no pixel is surer than this
# Log-odds of "another thing" against "the same, perhaps in the shadow", by logistic regression on true masks of
# simulated and of ray-cast videos (AV1): weights of the features of `_features`, in their order.
_WEIGHTS = (0.74, 1.42, 0.83, -5.54, 2.11, 2.33)
_BIAS = -1.09

_GUIDE_WINDOW = 9  # px
_GUIDE_NOISE = 60.0  # grey levels²; weaker edges of the picture do not hold the outline

_COLOUR_BINS = (12, 24, 24)  # of CIE Lab
_RARE = 1e-5  # share of a colour that was never met
_MOST_BY_COLOUR = 3.0  # log-odds


def to_lab(rgb: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w 3"]:
    """CIE Lab: lightness 0..100, colour about ±100."""
    return cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)


def change(
    frame: UInt8[ndarray, "h w 3"], reference: UInt8[ndarray, "h w 3"], noise: Float32[ndarray, "h w"]
) -> Float32[ndarray, "h w"]:
    """Log-odds, within ±6, that a pixel of a frame shows another thing than the reference.

    `noise` is the pixel's usual distance from the reference in CIE Lab. A shadow, or its end, scales all channels
    alike and evenly and leaves the texture as it is; where there is neither colour nor texture, a thing can be taken
    for a shadow.
    """
    scale = np.minimum(noise, _NOISE_CEILING * np.median(noise))
    odds = np.full(noise.shape, _BIAS, np.float32)
    for weight, feature in zip(_WEIGHTS, _features(frame, reference, scale), strict=True):
        odds += np.float32(weight) * feature
    return odds.clip(-_MOST, _MOST)


def _features(
    frame: UInt8[ndarray, "h w 3"], reference: UInt8[ndarray, "h w 3"], noise: Float32[ndarray, "h w"]
) -> tuple[ndarray, ...]:
    """Unevenness of the ratio over the channels; change of colour beyond that of lightness; unevenness of the ratio
    over neighbours; correlation of texture; distance in noise levels; brightening.
    """
    lab, before = to_lab(frame), to_lab(reference)
    distance = np.linalg.norm(lab - before, axis=-1) / noise
    lightness = (lab[..., 0] + 1) / (before[..., 0] + 1)
    colour = np.linalg.norm(lab[..., 1:] - lightness[..., None] * before[..., 1:], axis=-1)
    ratio = np.log((frame + np.float32(_DARK)) / (reference + np.float32(_DARK)))
    mean = ratio.mean(-1)
    tint = np.abs(ratio - mean[..., None]).max(-1)
    even = cv2.blur(np.abs(mean - cv2.medianBlur(mean, _EVEN_WINDOW)), (_EVEN_WINDOW, _EVEN_WINDOW))
    alike = _texture_correlation(lab[..., 0], before[..., 0])
    return np.log(tint + 0.02), np.log(colour + 1), np.log(even + 0.01), alike, np.log(distance + 1), mean.clip(0)


def _texture_correlation(a: Float32[ndarray, "h w"], b: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Normalised cross-correlation of two images in a window about every pixel; two flat windows correlate."""

    def mean(image: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
        return cv2.blur(image, (_TEXTURE_WINDOW, _TEXTURE_WINDOW))

    a_mean, b_mean, floor = mean(a), mean(b), _TEXTURE_NOISE**2
    covariance = mean(a * b) - a_mean * b_mean + floor
    a_variance = (mean(a * a) - a_mean**2).clip(0) + floor
    b_variance = (mean(b * b) - b_mean**2).clip(0) + floor
    return covariance / np.sqrt(a_variance * b_variance)


def along_edges(odds: Float32[ndarray, "h w"], frame: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    """Log-odds smoothed within the picture's edges: guided filter (He et al. 2013) with the colours as the guide."""

    def mean(image: ndarray) -> ndarray:
        return cv2.blur(image, (_GUIDE_WINDOW, _GUIDE_WINDOW))

    guide = frame.astype(np.float32)
    guide_mean, odds_mean = mean(guide), mean(odds)
    with_odds = mean(guide * odds[..., None]) - guide_mean * odds_mean[..., None]
    r, g, b = (guide[..., k] for k in range(3))
    products = mean(np.stack((r * r, r * g, r * b, g * g), axis=-1)), mean(np.stack((g * b, b * b), axis=-1))
    rr, rg, rb, gg, gb, bb = np.moveaxis(np.concatenate(products, axis=-1), -1, 0)
    mr, mg, mb = np.moveaxis(guide_mean, -1, 0)
    rr, gg, bb = rr - mr * mr + _GUIDE_NOISE, gg - mg * mg + _GUIDE_NOISE, bb - mb * mb + _GUIDE_NOISE
    rg, rb, gb = rg - mr * mg, rb - mr * mb, gb - mg * mb
    # the inverse of the symmetric 3x3 covariance, by cofactors
    c_rr, c_rg, c_rb = gg * bb - gb * gb, rb * gb - rg * bb, rg * gb - rb * gg
    c_gg, c_gb, c_bb = rr * bb - rb * rb, rb * rg - rr * gb, rr * gg - rg * rg
    pr, pg, pb = np.moveaxis(with_odds, -1, 0)
    slope = (
        np.stack(
            (c_rr * pr + c_rg * pg + c_rb * pb, c_rg * pr + c_gg * pg + c_gb * pb, c_rb * pr + c_gb * pg + c_bb * pb),
            axis=-1,
        )
        / (rr * c_rr + rg * c_rg + rb * c_rb)[..., None]
    )
    offset = odds_mean - (slope * guide_mean).sum(-1)
    return (mean(slope) * guide).sum(-1) + mean(offset)


class Colours:
    """Which colours things that move have, and which the empty scene: histograms of CIE Lab, filled frame by frame."""

    def __init__(self) -> None:
        self._counts = np.zeros((2, *_COLOUR_BINS), np.float64)

    def add(self, frame: UInt8[ndarray, "h w 3"], odds: Float32[ndarray, "h w"], sure: float) -> None:
        """Count the pixels whose log-odds of moving are beyond ± `sure`."""
        index = _bins(frame)
        for counts, chosen in zip(self._counts, (odds > sure, odds < -sure), strict=True):
            counts += np.bincount(index[chosen], minlength=counts.size).reshape(counts.shape)

    def odds(self, frame: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
        """Log-odds, within ±3, that a pixel belongs to something that moves, from its colour alone."""
        moving, empty = (_spread(counts / max(counts.sum(), 1)) for counts in self._counts)
        table = np.log((moving + _RARE) / (empty + _RARE)).clip(-_MOST_BY_COLOUR, _MOST_BY_COLOUR)
        return table.ravel()[_bins(frame)].astype(np.float32)


def _bins(frame: UInt8[ndarray, "h w 3"]) -> Int[ndarray, "h w"]:
    share = (to_lab(frame) + np.array([0, 80, 80], np.float32)) / np.array([100, 160, 160], np.float32)
    index = (share * _COLOUR_BINS).astype(int).clip(0, np.array(_COLOUR_BINS) - 1)
    return np.ravel_multi_index(tuple(np.moveaxis(index, -1, 0)), _COLOUR_BINS)


def _spread(shares: ndarray) -> ndarray:
    """A histogram with every bin shared among its neighbours (1/4, 1/2, 1/4 along each axis)."""
    for axis, size in enumerate(shares.shape):
        padded = np.pad(shares, [(1, 1) if k == axis else (0, 0) for k in range(shares.ndim)])
        before, at, after = (np.take(padded, np.arange(size) + shift, axis) for shift in range(3))
        shares = 0.25 * before + 0.5 * at + 0.25 * after
    return shares
