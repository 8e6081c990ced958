# mypy: disable-error-code="no-untyped-def"
"""Kernel that sorts the Gaussians of every view by depth and lists them tile by tile."""

import numpy as np

from lerobot_msdyn.render.cpu.jit import device, kernel
from lerobot_msdyn.render.cpu.simd import take_ticket

_DIGIT_BITS = 11
_DIGITS = 1 << _DIGIT_BITS
_PASSES = 3  # 33 bits, for depths of 32
_HALF = np.uint64(32)
_INDEX = np.uint64(0xFFFFFFFF)  # the half of a key that is one
_LAST = np.uint64(0xFFFFFFFFFFFFFFFF)


@device
def _key(bits, index):
    """Orders by depth, then by index: the bits of positive floats order like the floats themselves."""
    return (np.uint64(bits) << _HALF) | np.uint64(index)


@device
def _in_order(counts, depths, ahead):
    """Indices of the visible Gaussians from near to far, equal depths by index; the first `ahead` are so already."""
    bits = depths.view(np.uint32)
    first = np.empty(ahead + 1, np.uint64)
    shown = 0
    for index in range(ahead):
        first[shown] = _key(bits[index], index)
        if counts[index] > 0:
            shown += 1
    first[shown] = _LAST
    second = _sorted_keys(counts, bits, ahead)
    order = np.empty(shown + second.shape[0] - 1, np.int32)
    i, j = 0, 0
    for position in range(order.shape[0]):  # no branch, which would be guessed wrong half the time
        one, other = first[i], second[j]
        order[position] = np.int32(min(one, other) & _INDEX)
        nearer = 1 if one < other else 0
        i, j = i + nearer, j + 1 - nearer
    return order


@device
def _sorted_keys(counts, bits, ahead):
    """Keys of the visible Gaussians from `ahead` on, by a radix sort, and one that is behind all."""
    visible = 0
    histogram = np.zeros((_PASSES, _DIGITS), np.int32)
    keys = np.empty(counts.shape[0] - ahead + 1, np.uint64)
    for index in range(ahead, counts.shape[0]):
        if counts[index] > 0:
            keys[visible] = _key(bits[index], index)
            visible += 1
            for digit in range(_PASSES):
                place = (np.uint64(bits[index]) >> np.uint64(_DIGIT_BITS * digit)) & np.uint64(_DIGITS - 1)
                histogram[digit, place] += 1
    other = np.empty(visible + 1, np.uint64)
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
        shift = _HALF + np.uint64(_DIGIT_BITS * digit)
        for position in range(visible):
            key = keys[position]
            place = (key >> shift) & np.uint64(_DIGITS - 1)
            other[starts[place]] = key
            starts[place] += 1
        keys, other = other, keys
    keys[visible] = _LAST
    return keys[: visible + 1]


@kernel
def list_per_tile(tickets, ahead, counts, depths, rects, ends_of_views, across, starts, listed, offsets, slots):
    """Write the depth-sorted list of every tile, view by view.

    Args:
        tickets: shared counter of the threads; one ticket is one view.
        ahead: Gaussians of a backdrop, which come first, from near to far.
        counts: tiles that each Gaussian meets, `[b, g]`.
        depths: z-depth, `[b, g]`.
        rects: the tiles that each Gaussian meets, `[b, g, 4]`.
        ends_of_views: where the lists of each view end, `[b]`.
        across: tiles in a row of the image.
        starts: out, where each tile's list starts, `[b, tiles + 1]`.
        listed: out, indices of Gaussians, all lists one after the other.
        offsets: out, first gradient slot of each Gaussian, `[b, g]`; of no size without gradients.
        slots: out, the gradient slot of each list entry, likewise.
    """
    views = counts.shape[0]
    tiles = starts.shape[1] - 1
    while True:
        view = take_ticket(tickets)
        if view >= views:
            break
        order = _in_order(counts[view], depths[view], ahead)
        start, rect = starts[view], rects[view]
        start[:] = 0
        for index in order:
            for y in range(rect[index, 2], rect[index, 3] + 1):
                for x in range(rect[index, 0], rect[index, 1] + 1):
                    start[y * across + x + 1] += 1
        start[0] = ends_of_views[view - 1] if view > 0 else 0
        for tile in range(tiles):
            start[tile + 1] += start[tile]
        ends = start.copy()
        if slots.shape[0] > 0:
            slot = start[0]
            for index in range(counts.shape[1]):
                offsets[view, index] = slot
                slot += counts[view, index]
        for index in order:
            slot = offsets[view, index] if slots.shape[0] > 0 else 0
            for y in range(rect[index, 2], rect[index, 3] + 1):
                for x in range(rect[index, 0], rect[index, 1] + 1):
                    place = ends[y * across + x]
                    ends[y * across + x] = place + 1
                    listed[place] = index
                    if slots.shape[0] > 0:
                        slots[place] = slot
                    slot += 1
