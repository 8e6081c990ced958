"""How much of a new picture was never seen, and what stands there instead."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

HOLE_ALPHA = 0.5  # below this opacity nothing is known to be there
INPAINT_RADIUS_PX = 3


def fill_holes(rgb: UInt8[ndarray, "h w 3"], alpha: Float[ndarray, "h w"]) -> tuple[UInt8[ndarray, "h w 3"], float]:
    """A picture whose holes are filled from their borders (Telea 2004), and the share of pixels that were holes."""
    holes = (alpha < HOLE_ALPHA).astype(np.uint8)
    share = float(holes.mean())
    if share in (0.0, 1.0):
        return rgb, share
    return cv2.inpaint(rgb, holes, INPAINT_RADIUS_PX, cv2.INPAINT_TELEA), share
