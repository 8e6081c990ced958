"""Pixels that differ from an image of the empty scene by more than noise and shadows."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

_NOISE_CEILING = 2.0  # times the image's median noise: a pixel that is often covered only looks noisy
_SURE, _POSSIBLE = 8.0, 4.0  # thresholds of the hysteresis, in noise levels
_SHADOW_LIGHTNESS = (0.4, 1.15)  # a shadow, or its end, changes the lightness by such a factor ...
_SHADOW_COLOUR = 10.0  # ... the colour, beyond that factor, by at most so many CIE Lab units ...
_SHADOW_CORRELATION = 0.6  # ... and leaves the texture as it is
_TEXTURE_WINDOW = 7  # px
_TEXTURE_NOISE = 2.0  # Lab units; flatter than this, a window has no texture


def to_lab(rgb: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w 3"]:
    """CIE Lab: lightness 0..100, colour about ±100."""
    return cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)


def changes(
    frames: UInt8[ndarray, "t h w 3"], reference: UInt8[ndarray, "h w 3"], noise: Float32[ndarray, "h w"]
) -> Bool[ndarray, "t h w"]:
    """Pixels of each frame that show something else than the reference does.

    Hysteresis on the distance in CIE Lab, in units of the pixel's own noise: a connected region counts as changed if
    some of it surely is. Shadows and moderate changes of brightness do not count; a black or grey thing on a plain
    darker or brighter ground can be taken for one.
    """
    lab = to_lab(reference)
    scale = np.minimum(noise, _NOISE_CEILING * np.median(noise))
    return np.stack([_changed(to_lab(frame), lab, scale) for frame in frames])


def _changed(
    lab: Float32[ndarray, "h w 3"], reference: Float32[ndarray, "h w 3"], noise: Float32[ndarray, "h w"]
) -> Bool[ndarray, "h w"]:
    distance = np.linalg.norm(lab - reference, axis=-1) / noise
    distance[_is_shadow(lab, reference)] = 0
    distance = cv2.medianBlur(distance.astype(np.float32), 3)
    count, components = cv2.connectedComponents((distance > _POSSIBLE).astype(np.uint8), connectivity=8)
    sure = np.zeros(count, bool)
    sure[components[distance > _SURE]] = True
    return sure[components]


def _is_shadow(lab: Float32[ndarray, "h w 3"], reference: Float32[ndarray, "h w 3"]) -> Bool[ndarray, "h w"]:
    """Same colour and texture, another brightness: a shadow scales lightness and colour alike."""
    ratio = (lab[..., 0] + 1) / (reference[..., 0] + 1)
    colour = np.linalg.norm(lab[..., 1:] - ratio[..., None] * reference[..., 1:], axis=-1)
    alike = (ratio > _SHADOW_LIGHTNESS[0]) & (ratio < _SHADOW_LIGHTNESS[1]) & (colour < _SHADOW_COLOUR)
    return alike & (_texture_correlation(lab[..., 0], reference[..., 0]) > _SHADOW_CORRELATION)


def _texture_correlation(a: Float32[ndarray, "h w"], b: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Normalised cross-correlation of two images in a window about every pixel; two flat windows correlate."""

    def mean(image: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
        return cv2.blur(image, (_TEXTURE_WINDOW, _TEXTURE_WINDOW))

    a_mean, b_mean, floor = mean(a), mean(b), _TEXTURE_NOISE**2
    covariance = mean(a * b) - a_mean * b_mean + floor
    a_variance = (mean(a * a) - a_mean**2).clip(0) + floor
    b_variance = (mean(b * b) - b_mean**2).clip(0) + floor
    return covariance / np.sqrt(a_variance * b_variance)
