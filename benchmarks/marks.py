"""Pictures that say in themselves which camera, episode and frame they show, and a reader of what they say."""

from pathlib import Path

import av
import cv2
import numpy as np

CAMERAS = ("front", "side")
WIDTH, HEIGHT = 64, 48
CELL = 5  # px
BITS = (1, 2, 4)  # of the camera, the episode and the frame
COLUMNS = 2 + sum(BITS)  # the first is always light above, the last below
PLACE = (9, 8)  # x, y of the mark where the camera stands still
SEARCH = 12  # px around it
CONTRAST = 40.0  # of 255, below which a bit cannot be read
DARK, LIGHT = 10, 245
Mark = tuple[int, int, int]  # camera, episode, frame


def picture(mark: Mark, shift: tuple[int, int] = (0, 0)) -> np.ndarray:
    """A textured table, a thing that moves over it, and the mark; uint8 [h,w,3], shifted by x, y px."""
    camera, _, frame = mark
    margin = 2 * SEARCH
    rng = np.random.default_rng(camera)
    coarse = rng.uniform(90, 160, (12, 15, 3)).astype(np.float32)
    whole = cv2.resize(coarse, (WIDTH + 2 * margin, HEIGHT + 2 * margin), interpolation=cv2.INTER_CUBIC)
    x, y = margin + PLACE[0], margin + PLACE[1]
    whole[y - 3 : y + 2 * CELL + 3, x - 3 : x + COLUMNS * CELL + 3] = 128
    for column, bit in enumerate(_bits(mark)):
        left = x + column * CELL
        whole[y : y + CELL, left : left + CELL] = LIGHT if bit else DARK
        whole[y + CELL : y + 2 * CELL, left : left + CELL] = DARK if bit else LIGHT
    left = margin + 4 + 3 * frame
    whole[margin + 34 : margin + 42, left : left + 8] = (200, 40, 60)
    top, left = margin - shift[1], margin - shift[0]
    return np.ascontiguousarray(whole[top : top + HEIGHT, left : left + WIDTH].round().clip(0, 255).astype(np.uint8))


def read_mark(image: np.ndarray) -> Mark | None:
    """What a picture uint8 [h,w,3] says; None where it cannot be read."""
    inner = CELL - 2
    means = cv2.blur(image.astype(np.float32).mean(2), (inner, inner), anchor=(0, 0))
    ys = np.arange(max(0, PLACE[1] - SEARCH), min(len(means) - 2 * CELL, PLACE[1] + SEARCH) + 1)
    xs = np.arange(max(0, PLACE[0] - SEARCH), min(means.shape[1] - COLUMNS * CELL, PLACE[0] + SEARCH) + 1)
    columns = xs + 1 + CELL * np.arange(COLUMNS)[:, None]
    upper = means[ys[:, None, None] + 1, columns]  # [y, column, x]
    lower = means[ys[:, None, None] + 1 + CELL, columns]
    difference, middle = upper - lower, (upper + lower) / 2
    contrast = np.abs(difference).min(1)
    # One half of a pair alone would do without this.
    contrast[middle.max(1) - middle.min(1) > contrast / 2] = 0
    y, x = np.unravel_index(contrast.argmax(), contrast.shape)
    found = [bool(value) for value in difference[y, :, x] > 0]
    if contrast[y, x] < CONTRAST or not found[0] or found[-1]:
        return None
    values, start = [], 1
    for bits in BITS:
        values.append(sum(int(bit) << i for i, bit in enumerate(found[start : start + bits])))
        start += bits
    return values[0], values[1], values[2]


def read_turned(image: np.ndarray) -> tuple[Mark | None, int]:
    """The same of a picture that may be turned: the mark, and the quarter turns to the left that it took to read it."""
    for turns in range(4):
        mark = read_mark(np.rot90(image, turns))
        if mark is not None:
            return mark, turns
    return None, 0


def turns_of(path: Path) -> int:
    """The quarter turns to the left that a video's display matrix asks for; none where it cannot be read."""
    try:
        with av.open(str(path)) as container:
            return round(next(container.decode(video=0)).rotation / 90) % 4
    except (av.FFmpegError, StopIteration, IndexError):
        return 0


def _bits(mark: Mark) -> list[bool]:
    bits = [bool(value >> i & 1) for value, count in zip(mark, BITS, strict=True) for i in range(count)]
    return [True, *bits, False]
