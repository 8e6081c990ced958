"""Pictures that were written, read back."""

from pathlib import Path

import cv2
import numpy as np


def read_picture(path: Path) -> np.ndarray:
    """Colours uint8 [h, w, 3], red first; an absent or damaged file fails the test."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    assert picture is not None, path
    return picture
