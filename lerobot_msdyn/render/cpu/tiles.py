# mypy: disable-error-code="no-untyped-def"
"""Tiles of an image, the blocks of pixels inside them, and which blocks an ellipse touches.

A tile is `TILE_WIDTH` x `TILE_HEIGHT` px; a block is one SIMD vector of pixels.
"""

import math

import numpy as np

from lerobot_msdyn.render.cpu.jit import device
from lerobot_msdyn.render.cpu.records import (
    HALF_HEIGHT,
    HALF_WIDTH,
    LOG2_OPACITY,
    XX,
    XY,
    YY,
)
from lerobot_msdyn.render.cpu.simd import (
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    LANES,
    at,
    both,
    ceil,
    floor,
    fma,
    greater,
    lane_index,
    lane_x,
    lane_y,
    larger,
    less,
    load,
    load_block,
    root,
    select,
    smaller,
    splat,
    store,
    store_block,
    store_truncated,
    zeros,
)
from lerobot_msdyn.render.types import MIN_ALPHA

TILE_WIDTH, TILE_HEIGHT = 64, 32  # px; large tiles share the set-up of a Gaussian among many blocks
BLOCKS_ACROSS = TILE_WIDTH // BLOCK_WIDTH
BLOCKS_DOWN = TILE_HEIGHT // BLOCK_HEIGHT
BLOCKS = BLOCKS_ACROSS * BLOCKS_DOWN
SPANS = -(-BLOCKS_DOWN // LANES) * LANES  # rows of blocks, padded to whole vectors

_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_LOG2_MIN_ALPHA = np.float32(math.log2(MIN_ALPHA))
_SLACK = np.float32(0.01)  # px; spans may be too long, never too short
_PIXEL_SPAN = np.float32(BLOCK_HEIGHT - 1)
_PER_BLOCK = np.float32(1 / BLOCK_WIDTH)


@device
def tiles_of(width, height):
    """Tiles in a row and in a column of an image."""
    return (width + TILE_WIDTH - 1) // TILE_WIDTH, (height + TILE_HEIGHT - 1) // TILE_HEIGHT


@device
def first_pixel(x):
    """The first pixel index that is not below x, nor below 0 (math.ceil would be a call that spills vectors)."""
    whole = np.int64(max(x, _ZERO))
    return whole + 1 if whole < x else whole


@device
def last_pixel(x):
    """The last pixel index that is not above x; -1 if there is none."""
    return np.int64(max(x + _ONE, _ZERO)) - 1


@device
def tile_place(tile, across, down, width, height):
    """View, left and top (px) of a tile, and its size within the image (px)."""
    view, rest = tile // (across * down), tile % (across * down)
    left, top = rest % across * TILE_WIDTH, rest // across * TILE_HEIGHT
    return view, left, top, min(TILE_WIDTH, width - left), min(TILE_HEIGHT, height - top)


@device
def block_spans(records, base, center_x, center_y, columns, rows, first, last):
    """Blocks that an ellipse touches in every row of blocks of a tile.

    Writes first[row], last[row] (last < first: none); returns the first and last row of blocks that it touches.
    Within a row of blocks, the ellipse xx u² + xy u v + yy v² = level reaches furthest at the v where it does so as
    a whole, or at the edge of the row that is nearest to it.
    """
    xx, xy, yy = at(records, base + XX), at(records, base + XY), at(records, base + YY)
    half_width, half_height = at(records, base + HALF_WIDTH), at(records, base + HALF_HEIGHT)
    level = _LOG2_MIN_ALPHA - at(records, base + LOG2_OPACITY)
    inverse_xx = _ONE / xx
    slope = splat(-_HALF * xy * inverse_xx)  # u of the ellipse's middle, per v
    v_widest = -_HALF * xy * half_width / yy
    # half length of the chord at v: sqrt(level / xx (1 - v² / half_height²))
    chord = splat(level * inverse_xx)
    fall = splat(-level * inverse_xx / (half_height * half_height))
    for row in range(0, SPANS, LANES):
        above = fma(lane_index(), splat(np.float32(BLOCK_HEIGHT)), splat(np.float32(row * BLOCK_HEIGHT) - center_y))
        low, high = above - splat(_SLACK), above + splat(_PIXEL_SPAN + _SLACK)
        v = smaller(larger(splat(v_widest), low), high)
        right = fma(slope, v, root(larger(fma(fall, v * v, chord), zeros())))
        v = smaller(larger(splat(-v_widest), low), high)
        left = slope * v - root(larger(fma(fall, v * v, chord), zeros()))
        left_pixel = larger(ceil(left + splat(center_x - _SLACK)), zeros())
        right_pixel = smaller(floor(right + splat(center_x + _SLACK)), splat(np.float32(columns - 1)))
        empty = greater(left_pixel, right_pixel)
        store_truncated(first, row, floor(left_pixel * splat(_PER_BLOCK)))
        store_truncated(last, row, select(empty, splat(-_ONE), floor(right_pixel * splat(_PER_BLOCK))))
    top = first_pixel(center_y - half_height)
    bottom = min(last_pixel(center_y + half_height), rows - 1)
    return top // BLOCK_HEIGHT, bottom // BLOCK_HEIGHT


@device
def block_size(block, columns, rows):
    """Columns and rows (px) of a block that are inside the image; not positive where it is outside."""
    return columns - block % BLOCKS_ACROSS * BLOCK_WIDTH, rows - block // BLOCKS_ACROSS * BLOCK_HEIGHT


@device
def inside_image(inside_x, inside_y):
    """Mask of the lanes of a block of which this many columns and rows are inside the image."""
    return both(less(lane_x(), splat(np.float32(inside_x))), less(lane_y(), splat(np.float32(inside_y))))


@device
def read_block(image, start, width, columns, rows, spare):
    """A block of an image; zeros outside of it."""
    if columns >= BLOCK_WIDTH and rows >= BLOCK_HEIGHT:
        return load_block(image, start, width)
    store(spare, 0, zeros())
    for y in range(min(rows, BLOCK_HEIGHT)):
        for x in range(min(columns, BLOCK_WIDTH)):
            spare[y * BLOCK_WIDTH + x] = image[start + y * width + x]
    return load(spare, 0)


@device
def write_block(image, start, width, columns, rows, spare, value):
    """Write the part of a block that is inside the image."""
    if columns >= BLOCK_WIDTH and rows >= BLOCK_HEIGHT:
        store_block(image, start, width, value)
        return
    store(spare, 0, value)
    for y in range(min(rows, BLOCK_HEIGHT)):
        for x in range(min(columns, BLOCK_WIDTH)):
            image[start + y * width + x] = spare[y * BLOCK_WIDTH + x]
