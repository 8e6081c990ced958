"""How far a picture is from the true one, inside a mask: plain functions of 8-bit pictures, nothing learned.

Two kinds of structural similarity, which must not be compared with each other: `partial_ssim` is DyCheck's mSSIM
(Gao et al., NeurIPS 2022, `dycheck/core/metrics/image.py`), averaged over the whole map, so that what the mask leaves
out counts as perfect; `inside_ssim` is averaged inside the mask alone.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

WINDOW, SIGMA = 11, 1.5  # px, of the Gaussian window (Wang et al. 2004)
C1, C2 = 0.01**2, 0.03**2  # for colours 0..1
LEVELS = 255

Picture = UInt8[ndarray, "h w 3"]
Mask = Bool[ndarray, "h w"] | Float[ndarray, "h w"]
Map = Float[ndarray, "h w 3"]


def quantised(rgb: Float[ndarray, "*t h w 3"]) -> UInt8[ndarray, "*t h w 3"]:
    """Colours 0..1 as 8-bit pictures, truncated as DyCheck does."""
    return (rgb.clip(0, 1) * LEVELS).astype(np.uint8)


def masked_psnr_db(rendered: Picture, true: Picture, mask: Mask) -> float:
    """Peak signal-to-noise ratio (dB) over the mask (mPSNR); infinite where nothing differs or the mask is empty."""
    weight = mask.astype(np.float64)[..., None]
    error = weight * (_unit(rendered) - _unit(true)) ** 2
    mean = error.sum() / max(3 * weight.sum(), 1e-6)
    return float(-10 * np.log10(mean)) if mean > 0 else float("inf")


def partial_ssim(rendered: Picture, true: Picture, mask: Mask) -> float:
    """DyCheck's mSSIM: partial convolutions along rows, then columns; the mean over all pixels of the map.

    The map has no borders ("valid"). Windows without any mask count 1, so the value rises with what the mask leaves
    out: it is comparable only under the same masks.
    """
    a, b, weight = _unit(rendered), _unit(true), mask.astype(np.float64)
    mean_a, mean_b = _partial(a, weight), _partial(b, weight)
    var_a = np.maximum(_partial(a * a, weight) - mean_a * mean_a, 0)
    var_b = np.maximum(_partial(b * b, weight) - mean_b * mean_b, 0)
    bound = np.sqrt(var_a * var_b)
    covariance = (_partial(a * b, weight) - mean_a * mean_b).clip(-bound, bound)
    return float(_similarity(mean_a, mean_b, var_a, var_b, covariance).mean())


def inside_ssim(rendered: Picture, true: Picture, mask: Bool[ndarray, "h w"]) -> float:
    """Structural similarity with moments over the mask alone, averaged inside it; the mask must not be empty."""
    a, b, weight = _unit(rendered), _unit(true), mask.astype(np.float64)
    share = np.maximum(_blurred(weight), 1e-4)[..., None]

    def mean(values: Map) -> Map:
        return _blurred(values * weight[..., None]) / share

    mean_a, mean_b = mean(a), mean(b)
    var_a = np.maximum(mean(a * a) - mean_a * mean_a, 0)
    var_b = np.maximum(mean(b * b) - mean_b * mean_b, 0)
    return float(_similarity(mean_a, mean_b, var_a, var_b, mean(a * b) - mean_a * mean_b)[mask].mean())


def flicker(
    rendered: UInt8[ndarray, "t h w 3"], true: UInt8[ndarray, "t h w 3"], masks: Bool[ndarray, "t h w"]
) -> float:
    """How much pictures of a camera that stands still change from one to the next beyond what truly changes.

    Mean absolute difference, in levels of 0..255, between the rendered change and the true one, over pixels that are
    inside the mask at both times; NaN where there are none.
    """
    both = masks[1:] & masks[:-1]
    if not both.any():
        return float("nan")
    wrong = rendered.astype(np.int16) - true
    return float(np.abs(np.diff(wrong, axis=0))[both].mean())


def _unit(picture: Picture) -> Map:
    return picture.astype(np.float64) / LEVELS


def _similarity(mean_a: Map, mean_b: Map, var_a: Map, var_b: Map, covariance: Map) -> Map:
    """The map of structural similarity."""
    above = (2 * mean_a * mean_b + C1) * (2 * covariance + C2)
    return above / ((mean_a**2 + mean_b**2 + C1) * (var_a + var_b + C2))


def _kernel() -> Float[ndarray, " k"]:
    offsets = np.arange(WINDOW) - WINDOW // 2
    values = np.exp(-0.5 * (offsets / SIGMA) ** 2)
    return values / values.sum()


def _partial(values: Map, weight: Float[ndarray, "h w"]) -> Float[ndarray, "H W 3"]:
    """Weighted means by two one-dimensional partial convolutions; 0 where a window holds no weight."""
    kernel, edge, one = _kernel(), WINDOW // 2, np.ones(1)
    for taps, ones, inside in (
        ((kernel, one), (np.ones(WINDOW), one), np.s_[:, edge:-edge]),
        ((one, kernel), (one, np.ones(WINDOW)), np.s_[edge:-edge, :]),
    ):
        total = cv2.sepFilter2D(weight, cv2.CV_64F, *ones)[inside][..., None]
        weighted = cv2.sepFilter2D(values * weight[..., None], cv2.CV_64F, *taps)[inside]
        values = np.where(total > 0, weighted * WINDOW / np.maximum(total, 1e-12), 0)
        weight = (total[..., 0] > 0).astype(np.float64)
    return values


def _blurred(values: Float[ndarray, "h w"] | Map) -> Float[ndarray, "h w"] | Map:
    return cv2.GaussianBlur(values, (WINDOW, WINDOW), SIGMA, borderType=cv2.BORDER_CONSTANT)
