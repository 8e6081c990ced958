"""Frames of a video that flash: somewhere brighter, or darker, than the frames before and after.

What is seen for one frame only, as a fault of a single overlay, is no motion: where things move, a place passes from
one brightness to another. All frames of a new view are looked at as they are rendered, also outside of what was
recorded.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from lerobot_msdyn.core.config import GateConfig
from lerobot_msdyn.views.pictures import Picture

CELLS = 20, 15  # columns and rows, whose means are compared
FLOOR = 0.1  # of the range of a colour: a flash up to which none is noticed


@dataclass(frozen=True)
class Flash:
    """The largest flash of a video."""

    frame: int = 0
    size: float = 0.0  # of a colour 0..1, of a cell's mean against the nearer of those before and after

    def entry(self) -> dict[str, Any]:
        """As plain values, for the record."""
        return {"frame": self.frame, "size": round(self.size, 4)}


class Flashes:
    """Looks, as pictures pass by, for the largest flash of each camera."""

    def __init__(self) -> None:
        self._cells: dict[str, list[ndarray]] = {}

    def kept(self, key: str, pictures: Iterable[Picture]) -> Iterator[Picture]:
        """The same pictures of a camera."""
        for picture in pictures:
            self._cells.setdefault(key, []).append(_means(picture.rgb))
            yield picture

    def largest(self, key: str) -> Flash:
        """That of a camera whose pictures have passed."""
        return _largest(self._cells[key])


def largest_flash(video: Iterable[UInt8[ndarray, "h w 3"]]) -> Flash:
    """That of a video."""
    return _largest([_means(picture) for picture in video])


def too_large(new: Flash, recorded: Flash, config: GateConfig) -> str:
    """Why a new view is not kept, in words; empty if it is."""
    if new.size <= config.max_flash_ratio * recorded.size + FLOOR:
        return ""
    return (
        f"frame {new.frame} flashes by {new.size:.2f} of the brightness range, the recording by {recorded.size:.2f} at "
        f"most, over gate.max_flash_ratio {config.max_flash_ratio:g}"
    )


def _means(picture: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "rows columns 3"]:
    return cv2.resize(picture, CELLS, interpolation=cv2.INTER_AREA).astype(np.float32) / 255


def _largest(cells: list[ndarray]) -> Flash:
    if len(cells) < 3:
        return Flash()
    video = np.stack(cells)
    before, now, after = video[:-2], video[1:-1], video[2:]
    over, under = now - np.maximum(before, after), np.minimum(before, after) - now
    sizes = np.maximum(over, under).max((1, 2, 3))
    frame = int(sizes.argmax())
    return Flash(frame + 1, max(float(sizes[frame]), 0.0))
