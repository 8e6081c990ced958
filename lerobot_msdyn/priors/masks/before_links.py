"""What a robot holds before its links: pixels where the joints put a link, and the picture shows the thing's colours.

Joints and meshes say where links are, not what is before them. The colours of the links' pixels away from a thing are
compared with the thing's own, as histograms; a pixel that by far looks more like the thing, and is joined to it, is the
thing's. A thing of the links' colours keeps what it has.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt16
from numpy import ndarray
from scipy.ndimage import gaussian_filter

from lerobot_msdyn.core.sampling import scaled_window

BITS = (3, 6, 6)  # of the channels of CIE Lab: more of colour than of brightness
BLUR_BINS = 0.8  # by which histograms are smoothed
FEW = 20.0  # pixels of the thing's histogram, spread over all colours
MORE_LIKELY = 5.0  # times, as which a pixel counts as the thing's
DISTINCT = 0.6  # share of a thing's own pixels that must be told from the links so
LEAST_PX = 30  # of a thing, over all frames, to know its colours by
LEAST_JOINED = 4  # pixels of a thing that what is joined to it touches
AWAY_PX = 12.0  # of 320: from a thing, where links are sure to show themselves


def shown_before(
    rgb: UInt8[ndarray, "t h w 3"], links: Bool[ndarray, "t h w"], others: UInt8[ndarray, "t h w"]
) -> UInt8[ndarray, "t h w"]:
    """Things, with what they hide of the links.

    Args:
        rgb: the pictures.
        links: where links are that move.
        others: instances but the robot (0 = none).
    """
    things = np.where(links, 0, others)
    colour = np.stack([_bins(picture) for picture in rgb])
    window = scaled_window(AWAY_PX, links.shape[2])
    for index in np.unique(things[things > 0]).tolist():
        own = things == index
        away = links & ~np.stack([cv2.dilate(one, window) > 0 for one in own.astype(np.uint8)])
        if min(own.sum(), away.sum()) < LEAST_PX:
            continue
        likely = _histogram(colour[own]) > MORE_LIKELY * _histogram(colour[away])
        if likely[colour[own]].mean() >= DISTINCT:
            things[_joined(likely[colour] & links & (things == 0), own)] = index
    return things


def _bins(picture: UInt8[ndarray, "h w 3"]) -> UInt16[ndarray, "h w"]:
    """The bin of each pixel's colour."""
    lab = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)
    bins = np.zeros(lab.shape[:2], np.uint16)
    for channel, bits in zip(cv2.split(lab), BITS, strict=True):
        bins = bins << bits | channel >> 8 - bits
    return bins


def _histogram(bins: UInt16[ndarray, " n"]) -> Float32[ndarray, " b"]:
    """Share of pixels in each bin, smoothed."""
    counts = np.bincount(bins, minlength=1 << sum(BITS)).astype(np.float32).reshape([1 << bits for bits in BITS])
    smooth = gaussian_filter(counts, BLUR_BINS).ravel()
    return (smooth + FEW / smooth.size) / (smooth.sum() + FEW)


def _joined(like: Bool[ndarray, "t h w"], own: Bool[ndarray, "t h w"]) -> Bool[ndarray, "t h w"]:
    """Those pixels that are joined to the thing's own, or to what was found in the frame before or after."""
    joined = np.zeros_like(like)
    window = np.ones((3, 3), np.uint8)
    for frames in (range(len(like)), range(len(like) - 1, -1, -1)):
        for t in frames:
            if not like[t].any():
                continue
            near = own[t] | joined[t] | joined[min(max(t - frames.step, 0), len(like) - 1)]
            touched = cv2.dilate(near.astype(np.uint8), window) > 0
            _, piece = cv2.connectedComponents(like[t].astype(np.uint8))
            counts = np.bincount(piece[touched & like[t]], minlength=int(piece.max()) + 1)
            joined[t] |= like[t] & (counts >= LEAST_JOINED)[piece]
    return joined
