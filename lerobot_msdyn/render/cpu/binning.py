# mypy: disable-error-code="no-untyped-def"
"""Kernel that sorts the Gaussians of every view by depth and lists them tile by tile."""

import numpy as np

from lerobot_msdyn.render.cpu.jit import device, kernel
from lerobot_msdyn.render.cpu.simd import take_ticket

_DIGIT_BITS = 11
_DIGITS = 1 << _DIGIT_BITS
_PASSES = 3  # 33 bits, for 32-bit keys


@device
def _sorted_by_depth(counts, depths):
    """Indices of the visible Gaussians from near to far, equal depths by index: a radix sort.

    The bits of positive floats order like the floats themselves. Each key carries its index in its low half.
    """
    visible = 0
    histogram = np.zeros((_PASSES, _DIGITS), np.int32)
    keys = np.empty(counts.shape[0], np.uint64)
    bits = depths.view(np.uint32)
    for index in range(counts.shape[0]):
        if counts[index] > 0:
            depth = np.uint64(bits[index])
            keys[visible] = (depth << np.uint64(32)) | np.uint64(index)
            visible += 1
            for digit in range(_PASSES):
                place = (depth >> np.uint64(_DIGIT_BITS * digit)) & np.uint64(_DIGITS - 1)
                histogram[digit, place] += 1
    other = np.empty(visible, np.uint64)
    for digit in range(_PASSES):
        starts = histogram[digit]
        total, most = 0, 0
        for bucket in range(_DIGITS):
            here = starts[bucket]
            starts[bucket] = total
            total += here
            most = max(most, here)
        if most == visible:  # the digit is the same everywhere
            continue
        shift = np.uint64(32 + _DIGIT_BITS * digit)
        for position in range(visible):
            key = keys[position]
            place = (key >> shift) & np.uint64(_DIGITS - 1)
            other[starts[place]] = key
            starts[place] += 1
        keys, other = other, keys
    order = np.empty(visible, np.int32)
    for position in range(visible):
        order[position] = np.int32(keys[position] & np.uint64(0xFFFFFFFF))
    return order


@kernel
def list_per_tile(tickets, counts, depths, rects, offsets, across, starts, listed, slots):
    """Write the depth-sorted list of every tile, view by view.

    Args:
        tickets: shared counter of the threads; one ticket is one view.
        counts: tiles that each Gaussian meets, `[b, g]`.
        depths: z-depth, `[b, g]`.
        rects: the tiles that each Gaussian meets, `[b, g, 4]`.
        offsets: first gradient slot of each Gaussian, `[b, g + 1]` (the last is the next view's first).
        across: tiles in a row of the image.
        starts: out, where each tile's list starts, `[b, tiles + 1]`.
        listed: out, indices of Gaussians, all lists one after the other.
        slots: out, the gradient slot of each list entry.
    """
    views = counts.shape[0]
    tiles = starts.shape[1] - 1
    while True:
        view = take_ticket(tickets)
        if view >= views:
            break
        order = _sorted_by_depth(counts[view], depths[view])
        start, rect = starts[view], rects[view]
        start[:] = 0
        for index in order:
            for y in range(rect[index, 2], rect[index, 3] + 1):
                for x in range(rect[index, 0], rect[index, 1] + 1):
                    start[y * across + x + 1] += 1
        start[0] = offsets[view, 0]
        for tile in range(tiles):
            start[tile + 1] += start[tile]
        ends = start.copy()
        for index in order:
            slot = offsets[view, index]
            for y in range(rect[index, 2], rect[index, 3] + 1):
                for x in range(rect[index, 0], rect[index, 1] + 1):
                    place = ends[y * across + x]
                    ends[y * across + x] = place + 1
                    listed[place] = index
                    slots[place] = slot
                    slot += 1
