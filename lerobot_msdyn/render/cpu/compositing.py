# mypy: disable-error-code="no-untyped-def"
"""Kernels that blend the Gaussians of every tile front to back, and their gradient.

A tile keeps its pixels in a buffer of blocks, `LANES` pixels each. Only the blocks that the ellipse alpha = 1/255
touches are visited: for every row of blocks of the tile, all at once, the span of the ellipse is solved for.

The forward buffer of a block holds the transmittance (negative once a pixel is finished, 0 outside the image) and the
planes. The backward pass goes front to back as well, with R = sum over the Gaussians still to come of
(blending weight) x (incoming gradient . planes), so it needs no list of what was blended:
    dL/dalpha_i = T_i e_i - R_i / (1 - alpha_i),    e_i = incoming gradient . planes of i.
Every list entry sums its pixels into a slot of its own; `project_backward` adds the slots of a Gaussian in order.
No atomics, and the same bits for any number of threads.
"""

import numpy as np

from lerobot_msdyn.render.cpu.jit import device, kernel
from lerobot_msdyn.render.cpu.planes import (
    add_dot,
    add_weighted,
    add_weighted_to_memory,
    load_planes,
    plane_count,
    record_stride,
    splat_planes,
    store_lane_sums,
    zero_planes,
)
from lerobot_msdyn.render.cpu.records import CENTER_X, CENTER_Y, HEAD, LOG2_OPACITY, XX, XY, YY
from lerobot_msdyn.render.cpu.simd import (
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    LANES,
    any_lane,
    at,
    both,
    exp2,
    fma,
    fnma,
    greater,
    greater_equal,
    lane_x,
    lane_y,
    larger,
    less,
    load,
    magnitude,
    prefetch,
    select,
    set_sign,
    smaller,
    splat,
    store,
    take_ticket,
    zeros,
)
from lerobot_msdyn.render.cpu.tiles import (
    BLOCKS,
    BLOCKS_ACROSS,
    SPANS,
    block_size,
    block_spans,
    inside_image,
    read_block,
    tile_place,
    tiles_of,
    write_block,
)
from lerobot_msdyn.render.types import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

_AHEAD = 4  # list entries between asking for a record and reading it
_LOOK_EVERY = 32  # list entries between two looks whether the whole tile is finished
_BACKWARD_HEAD = 3  # vectors of a block before its planes: transmittance, R, gradient of alpha

_ONE, _HALF = np.float32(1), np.float32(0.5)
_MIN_ALPHA, _MAX_ALPHA = np.float32(MIN_ALPHA), np.float32(MAX_ALPHA)
_MIN_TRANSMITTANCE = np.float32(MIN_TRANSMITTANCE)


@device
def _center_in_tile(records, base, left, top):
    """Centre of a Gaussian relative to the centre of the tile's first pixel, px."""
    center_x = at(records, base + CENTER_X) - np.float32(left) - _HALF
    center_y = at(records, base + CENTER_Y) - np.float32(top) - _HALF
    return center_x, center_y


@device
def _quadratic(records, base):
    """XX, XY, YY and LOG2_OPACITY of a record, in every lane."""
    return (
        splat(at(records, base + XX)),
        splat(at(records, base + XY)),
        splat(at(records, base + YY)),
        splat(at(records, base + LOG2_OPACITY)),
    )


@device
def _pass_light(buffer, place, alphas):
    """Let the light of a block through one Gaussian.

    Returns:
        The transmittance before it, its blending weights, and the mask of the pixels where it is shown.
    """
    before = load(buffer, place)
    weight = alphas * before
    after = before - weight
    covers = greater_equal(alphas, splat(_MIN_ALPHA))
    shown = both(covers, greater(after, splat(_MIN_TRANSMITTANCE)))
    store(buffer, place, select(shown, after, set_sign(before, covers)))
    return before, select(shown, weight, zeros()), shown


@device
def _blend(buffer, cell, records, base, left, top, columns, rows, first, last, layout):
    """Add one Gaussian to the blocks of a tile."""
    center_x, center_y = _center_in_tile(records, base, left, top)
    row, last_row = block_spans(records, base, center_x, center_y, columns, rows, first, last)
    xx, xy, yy, log2_opacity = _quadratic(records, base)
    planes = splat_planes(records, base + HEAD, layout)
    while row <= last_row:
        dy = lane_y() + splat(np.float32(row * BLOCK_HEIGHT) - center_y)
        linear, rest = xy * dy, fma(yy * dy, dy, log2_opacity)
        for column in range(at(first, row), at(last, row) + 1):
            dx = lane_x() + splat(np.float32(column * BLOCK_WIDTH) - center_x)
            alphas = smaller(exp2(fma(dx, fma(xx, dx, linear), rest)), splat(_MAX_ALPHA))
            place = (row * BLOCKS_ACROSS + column) * cell
            _, weight, _ = _pass_light(buffer, place, alphas)
            add_weighted_to_memory(buffer, place + LANES, weight, planes)
        row += 1


@device
def _finished(buffer, cell):
    """Whether no pixel of the tile takes any more light."""
    most = load(buffer, 0)
    for block in range(1, BLOCKS):
        most = larger(most, load(buffer, block * cell))
    return not any_lane(greater(most, zeros()))


@kernel
def composite_forward(
    tickets, starts, listed, records, count, channels, width, height, layout, ends, image, depth, alpha
):
    """Blend every tile of every view.

    Args:
        tickets: shared counter of the threads; one ticket is one tile.
        starts: where each tile's list starts, `[b, tiles + 1]`.
        listed: depth-sorted indices of Gaussians.
        records: projected Gaussians, flat.
        count: Gaussians per view.
        channels: feature channels in use.
        width: px.
        height: px.
        layout: the kernel's planes.
        ends: out, where each tile's list stopped to matter, `[b, tiles]`.
        image: out, features `[b, channels, height, width]`, flat.
        depth: out, expected depth `[b, height, width]`, flat.
        alpha: out, `[b, height, width]`, flat.
    """
    stride = record_stride(layout)
    cell = (1 + plane_count(layout)) * LANES  # floats of a block in the buffer
    across, down = tiles_of(width, height)
    buffer = np.empty(BLOCKS * cell, np.float32)
    first, last = np.empty(SPANS, np.int32), np.empty(SPANS, np.int32)
    while True:
        tile = take_ticket(tickets)
        if tile >= ends.size:
            break
        view, left, top, columns, rows = tile_place(tile, across, down, width, height)
        _clear(buffer, cell, columns, rows)
        begin, end = starts[view, tile % (across * down)], starts[view, tile % (across * down) + 1]
        stop = end
        for entry in range(begin, end):
            base = (view * count + at(listed, entry)) * stride
            prefetch(records, (view * count + at(listed, min(entry + _AHEAD, end - 1))) * stride)
            _blend(buffer, cell, records, base, left, top, columns, rows, first, last, layout)
            if (entry - begin) % _LOOK_EVERY == _LOOK_EVERY - 1 and _finished(buffer, cell):
                stop = entry + 1
                break
        ends[view, tile % (across * down)] = stop
        _write_tile(buffer, cell, view, left, top, columns, rows, channels, width, height, image, depth, alpha)


@device
def _clear(buffer, cell, columns, rows):
    """Full transmittance inside the image, none outside; no light yet."""
    for block in range(BLOCKS):
        inside_x, inside_y = block_size(block, columns, rows)
        inside = inside_image(inside_x, inside_y)
        store(buffer, block * cell, select(inside, splat(_ONE), zeros()))
        for plane in range(block * cell + LANES, (block + 1) * cell, LANES):
            store(buffer, plane, zeros())


@device
def _write_tile(buffer, cell, view, left, top, columns, rows, channels, width, height, image, depth, alpha):
    """Copy a finished tile to the images; its depth is divided by alpha."""
    spare = np.empty(LANES, np.float32)
    for block in range(BLOCKS):
        inside_x, inside_y = block_size(block, columns, rows)
        if inside_x <= 0 or inside_y <= 0:
            continue
        x, y = left + block % BLOCKS_ACROSS * BLOCK_WIDTH, top + block // BLOCKS_ACROSS * BLOCK_HEIGHT
        place = block * cell
        covered = splat(_ONE) - magnitude(load(buffer, place))
        total = load(buffer, place + (1 + channels) * LANES)
        mean = select(greater(covered, zeros()), total / covered, zeros())
        start = (view * height + y) * width + x
        write_block(alpha, start, width, inside_x, inside_y, spare, covered)
        write_block(depth, start, width, inside_x, inside_y, spare, mean)
        for channel in range(channels):
            start = ((view * channels + channel) * height + y) * width + x
            value = load(buffer, place + (1 + channel) * LANES)
            write_block(image, start, width, inside_x, inside_y, spare, value)


@device
def _blend_backward(buffer, cell, records, base, left, top, columns, rows, first, last, layout, sums, slot):
    """Take one Gaussian off the blocks of a tile and sum its gradients into its slot."""
    center_x, center_y = _center_in_tile(records, base, left, top)
    row, last_row = block_spans(records, base, center_x, center_y, columns, rows, first, last)
    xx, xy, yy, log2_opacity = _quadratic(records, base)
    planes = splat_planes(records, base + HEAD, layout)
    d_planes = zero_planes(layout)
    sum_g, sum_x, sum_v = zeros(), zeros(), zeros()
    sum_xx, sum_xv, sum_vv = zeros(), zeros(), zeros()
    while row <= last_row:
        dy = lane_y() + splat(np.float32(row * BLOCK_HEIGHT) - center_y)
        linear, rest = xy * dy, fma(yy * dy, dy, log2_opacity)
        row_g, row_x, row_xx = zeros(), zeros(), zeros()
        for column in range(at(first, row), at(last, row) + 1):
            dx = lane_x() + splat(np.float32(column * BLOCK_WIDTH) - center_x)
            partial = fma(xx, dx, linear)
            uncapped = exp2(fma(dx, partial, rest))
            alphas = smaller(uncapped, splat(_MAX_ALPHA))
            place = (row * BLOCKS_ACROSS + column) * cell
            before, weight, shown = _pass_light(buffer, place, alphas)
            incoming = load_planes(buffer, place + _BACKWARD_HEAD * LANES, layout)
            d_planes = add_weighted(d_planes, weight, incoming)
            light = add_dot(load(buffer, place + 2 * LANES), planes, incoming)
            remaining = fnma(weight, light, load(buffer, place + LANES))
            store(buffer, place + LANES, remaining)
            g = alphas * (before * light - remaining / (splat(_ONE) - alphas))
            g = select(both(shown, less(uncapped, splat(_MAX_ALPHA))), g, zeros())
            slope = fma(xx, dx, partial)
            gx = g * slope
            row_g, row_x, row_xx = row_g + g, row_x + gx, fma(gx, slope, row_xx)
        row_v = row_g * dy
        sum_g, sum_x, sum_xx = sum_g + row_g, sum_x + row_x, sum_xx + row_xx
        sum_v, sum_xv, sum_vv = sum_v + row_v, fma(row_x, dy, sum_xv), fma(row_v, dy, sum_vv)
        row += 1
    # slope in y = share (slope in x) + rest dy
    share = splat(_HALF) * xy / xx
    rest = yy + yy - share * xy
    sum_y, sum_xy = fma(share, sum_x, rest * sum_v), fma(share, sum_xx, rest * sum_xv)
    sum_yy = fma(share, sum_xy, rest * fma(share, sum_xv, rest * sum_vv))
    store_lane_sums(sums, slot, (sum_g, sum_x, sum_y, sum_xx, sum_xy, sum_yy), d_planes)


@kernel
def composite_backward(
    tickets, starts, listed, slots, ends, records, count, channels, width, height, layout,
    image, depth, alpha, d_image, d_depth, d_alpha, sums,
):  # fmt: skip
    """Gradient of `composite_forward`: sums over the pixels of one Gaussian in one tile, one slot each.

    The arguments are those of the forward pass (with its outputs as inputs) and, flat and of the shapes of image,
    depth and alpha, their incoming gradients; `slots` names the slot of each list entry. Writes sums
    `[slots, layout.sums]`: six moments, then dL / d planes. With g = dL / d log(alpha) and (sx, sy) the slope of
    log2(alpha) by the pixel's position, the moments are the sums of g, g sx, g sy, g sx², g sx sy, g sy². Moments of
    the slope rather than of the offset: they are the gradients of centre and covariance but for a factor, where
    offsets would have to be multiplied by the conic afterwards, which cancels badly for elongated Gaussians.
    """
    stride, slot_size = record_stride(layout), sums.shape[1]
    cell = (_BACKWARD_HEAD + plane_count(layout)) * LANES
    across, down = tiles_of(width, height)
    buffer = np.zeros(BLOCKS * cell, np.float32)
    first, last = np.empty(SPANS, np.int32), np.empty(SPANS, np.int32)
    sums = sums.reshape(sums.size)
    while True:
        tile = take_ticket(tickets)
        if tile >= ends.size:
            break
        view, left, top, columns, rows = tile_place(tile, across, down, width, height)
        begin, end = starts[view, tile % (across * down)], starts[view, tile % (across * down) + 1]
        stop = ends[view, tile % (across * down)]
        _read_tile(
            buffer, cell, view, left, top, columns, rows, channels, width, height,
            image, depth, alpha, d_image, d_depth, d_alpha,
        )  # fmt: skip
        for entry in range(stop, end):
            for offset in range(0, slot_size, LANES):
                store(sums, at(slots, entry) * slot_size + offset, zeros())
        for entry in range(begin, stop):
            base = (view * count + at(listed, entry)) * stride
            prefetch(records, (view * count + at(listed, min(entry + _AHEAD, end - 1))) * stride)
            slot = at(slots, entry) * slot_size
            _blend_backward(buffer, cell, records, base, left, top, columns, rows, first, last, layout, sums, slot)


@device
def _read_tile(
    buffer, cell, view, left, top, columns, rows, channels, width, height,
    image, depth, alpha, d_image, d_depth, d_alpha,
):  # fmt: skip
    """Set up the buffer of the backward pass.

    With D = sum(w z) and depth = D / alpha, the gradient of D is d_depth / alpha, and alpha receives
    -d_depth depth / alpha on top of its own.
    """
    spare = np.empty(LANES, np.float32)
    for block in range(BLOCKS):
        inside_x, inside_y = block_size(block, columns, rows)
        place = block * cell
        if inside_x <= 0 or inside_y <= 0:
            store(buffer, place, zeros())
            continue
        inside = inside_image(inside_x, inside_y)
        x, y = left + block % BLOCKS_ACROSS * BLOCK_WIDTH, top + block // BLOCKS_ACROSS * BLOCK_HEIGHT
        start = (view * height + y) * width + x
        covered = read_block(alpha, start, width, inside_x, inside_y, spare)
        mean = read_block(depth, start, width, inside_x, inside_y, spare)
        d_covered = read_block(d_alpha, start, width, inside_x, inside_y, spare)
        d_mean = read_block(d_depth, start, width, inside_x, inside_y, spare)
        some = greater(covered, zeros())
        d_total = select(some, d_mean / covered, zeros())
        remaining = d_covered * covered  # the two parts of depth's gradient cancel in this sum
        for channel in range(channels):
            start = ((view * channels + channel) * height + y) * width + x
            value = read_block(image, start, width, inside_x, inside_y, spare)
            d_value = read_block(d_image, start, width, inside_x, inside_y, spare)
            store(buffer, place + (_BACKWARD_HEAD + channel) * LANES, d_value)
            remaining = fma(value, d_value, remaining)
        store(buffer, place + (_BACKWARD_HEAD + channels) * LANES, d_total)
        store(buffer, place, select(inside, splat(_ONE), zeros()))
        store(buffer, place + LANES, remaining)
        store(buffer, place + 2 * LANES, d_covered - d_total * mean)
