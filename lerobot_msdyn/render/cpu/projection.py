# mypy: disable-error-code="no-untyped-def"
"""Kernels that project Gaussians into views, and carry gradients back through the projection.

Arrays of Gaussians are `[1 or b, g, ...]`: shared by the views or one set per view. The formulas are those of
`reference._project`; what is written is described in `records`.
"""

import math

import numpy as np

from lerobot_msdyn.render.cpu.jit import device, kernel
from lerobot_msdyn.render.cpu.planes import MOMENTS, record_stride
from lerobot_msdyn.render.cpu.records import (
    CENTER_X,
    CENTER_Y,
    HALF_HEIGHT,
    HALF_WIDTH,
    HEAD,
    LOG2_OPACITY,
    XX,
    XY,
    YY,
)
from lerobot_msdyn.render.cpu.simd import take_ticket
from lerobot_msdyn.render.cpu.tiles import TILE_HEIGHT, TILE_WIDTH, first_pixel, last_pixel, tiles_of
from lerobot_msdyn.render.cpu.vectors3 import (
    add,
    apply,
    apply_transposed,
    combined,
    cross,
    dot,
    rotation_gradient,
    rotation_of,
    scale_columns,
    scaled,
    times,
)
from lerobot_msdyn.render.types import COVARIANCE_BLUR, FURTHEST, MIN_ALPHA, QUAT_LENGTHS, TANGENT_MARGIN

CHUNK = 512  # Gaussians that a thread takes at a time; fixed, so that sums are grouped alike on any machine

_ZERO, _ONE, _HALF, _TWO = np.float32(0), np.float32(1), np.float32(0.5), np.float32(2)
_BLUR = np.float32(COVARIANCE_BLUR)
_MIN_ALPHA = np.float32(MIN_ALPHA)
_LOG2_E = np.float32(math.log2(math.e))
_LOG2_MIN_ALPHA = np.float32(math.log2(MIN_ALPHA))
_MINUS_LN2 = np.float32(-math.log(2))
_MARGIN = np.float32(TANGENT_MARGIN / 2)
_LARGEST = np.float32(3e38)
_QUAT_INVERSE = (np.float32(1 / QUAT_LENGTHS[1]), np.float32(1 / QUAT_LENGTHS[0]))
_SLACK = np.float32(0.01)  # px; extents may be too large, never too small
_FURTHEST = np.float32(FURTHEST)


@device
def _triple(values, view, index):
    return (values[view, index, 0], values[view, index, 1], values[view, index, 2])


@device
def _pose(camera_from_world, view):
    """Rotation (rows) and translation of a view."""
    m = camera_from_world[view]
    rotation = ((m[0, 0], m[0, 1], m[0, 2]), (m[1, 0], m[1, 1], m[1, 2]), (m[2, 0], m[2, 1], m[2, 2]))
    return rotation, (m[0, 3], m[1, 3], m[2, 3])


@device
def _lens(intrinsics, view, width, height):
    """fx, fy, cx, cy (px) and the limits of the tangents: low x, high x, low y, high y."""
    fx, fy = intrinsics[view, 0, 0], intrinsics[view, 1, 1]
    cx, cy = intrinsics[view, 0, 2], intrinsics[view, 1, 2]
    w, h = np.float32(width), np.float32(height)
    margin_x, margin_y = _MARGIN * w / fx, _MARGIN * h / fy
    return fx, fy, cx, cy, -cx / fx - margin_x, (w - cx) / fx + margin_x, -cy / fy - margin_y, (h - cy) / fy + margin_y


@device
def _linearise(point, rotation, lens):
    """The perspective's derivative at a camera-space point.

    Returns:
        Clamped tangents (x, y); the Jacobian's entries (xx, xz, yy, yz); its rows in world axes (2 vectors).
    """
    inverse_z = _ONE / point[2]
    tangent_x = min(max(point[0] * inverse_z, lens[4]), lens[5])
    tangent_y = min(max(point[1] * inverse_z, lens[6]), lens[7])
    xx, yy = lens[0] * inverse_z, lens[1] * inverse_z
    xz, yz = -xx * tangent_x, -yy * tangent_y
    row_x = combined(xx, rotation[0], xz, rotation[2])
    row_y = combined(yy, rotation[1], yz, rotation[2])
    return (tangent_x, tangent_y), (xx, xz, yy, yz), row_x, row_y


@device
def _finite(value):
    return abs(value) <= _LARGEST


@device
def _unit_quat(quats, view, index):
    """The normalised quaternion, and one over the length that it had."""
    w, x, y, z = quats[view, index, 0], quats[view, index, 1], quats[view, index, 2], quats[view, index, 3]
    inverse = _ONE / math.sqrt(w * w + x * x + y * y + z * z)
    return (w * inverse, x * inverse, y * inverse, z * inverse), inverse


@device
def _usable(mean, scale, inverse_length, opacity):
    """Whether the numbers of a Gaussian can be rendered (see `check_values`, which reports what is wrong)."""
    finite = _finite(mean[0]) and _finite(mean[1]) and _finite(mean[2])
    sizes = min(scale[0], min(scale[1], scale[2])) >= _ZERO
    sizes = sizes and _finite(scale[0]) and _finite(scale[1]) and _finite(scale[2])
    turned = inverse_length >= _QUAT_INVERSE[0] and inverse_length <= _QUAT_INVERSE[1]
    return finite and sizes and turned and opacity >= _ZERO and opacity <= _ONE


@device
def _tile_range(low, high, side, tiles):
    """First and last tile that hold pixels whose centres lie in [low, high] px; first > last if none does."""
    return first_pixel(low - _HALF) // side, min(last_pixel(high - _HALF) // side, tiles - 1)


@kernel
def project_forward(
    tickets, means, quats, scales, opacities, features, camera_from_world, intrinsics, width, height, near, layout,
    ahead, records, rects, counts, depths, refused,
):  # fmt: skip
    """Project every Gaussian into every view.

    Writes per (view, Gaussian): its record (flat), the tiles that it meets (rects `[b, ahead + g, 4]`: first x, last x,
    first y, last y), their number (0: not rendered) and its z-depth, all behind those of the `ahead` Gaussians of a
    backdrop. Sets refused[0] if a number cannot be rendered.
    """
    views, count = counts.shape[0], means.shape[1]
    channels = features.shape[2]
    stride = record_stride(layout)
    blocks = (count + CHUNK - 1) // CHUNK
    while True:
        ticket = take_ticket(tickets)
        if ticket >= views * blocks:
            break
        view = ticket // blocks
        rotation, translation = _pose(camera_from_world, view)
        lens = _lens(intrinsics, view, width, height)
        features_view = min(view, features.shape[0] - 1)
        first = ticket % blocks * CHUNK
        for index in range(first, min(first + CHUNK, count)):
            place = ahead + index
            counts[view, place] = 0
            mean = _triple(means, min(view, means.shape[0] - 1), index)
            scale = _triple(scales, min(view, scales.shape[0] - 1), index)
            quat, inverse = _unit_quat(quats, min(view, quats.shape[0] - 1), index)
            opacity = opacities[min(view, opacities.shape[0] - 1), index]
            usable = _usable(mean, scale, inverse, opacity)
            for channel in range(channels):
                usable &= _finite(features[features_view, index, channel])
            if not usable:
                refused[0] = 1
                continue
            point = add(apply(rotation, mean), translation)
            depths[view, place] = point[2]
            if opacity < _MIN_ALPHA or not _before_camera(point, scale, lens, near):
                continue
            axes = scale_columns(rotation_of(quat), scale)
            base = (view * counts.shape[1] + place) * stride
            rect = _write_head(records, base, point, axes, opacity, rotation, lens, width, height)
            counts[view, place] = _write_rect(rects, view, place, rect)
            if counts[view, place] > 0:
                for channel in range(channels):
                    records[base + HEAD + channel] = features[features_view, index, channel]
                _end_record(records, base, stride, channels, point[2])


@kernel
def paint_backdrop(
    tickets, sources, heads, nearness, features, gains, hidden, width, height, layout,
    records, rects, counts, depths, refused,
):  # fmt: skip
    """What `project_forward` writes, of the Gaussians of a backdrop, which have been projected before.

    Args:
        tickets: shared counter of the threads; one ticket is a chunk of Gaussians in one view.
        sources: those that are rendered, `[v]`.
        heads: of their records, `[v, HEAD]`.
        nearness: their z-depth, m, `[v]`.
        features: of all of the backdrop, `[s, c]`.
        gains: by which they are multiplied, `[1 or b, s]`.
        hidden: those that are left out, `[1 or b, s]`.
        width: of the views, px.
        height: of the views, px.
        layout: the kernel's planes.
        records: out, flat.
        rects: out, `[b, v + g, 4]`.
        counts: out, `[b, v + g]`.
        depths: out, `[b, v + g]`.
        refused: out, set if a feature cannot be rendered.
    """
    views, count = counts.shape[0], heads.shape[0]
    channels = features.shape[1]
    stride = record_stride(layout)
    blocks = (count + CHUNK - 1) // CHUNK
    while True:
        ticket = take_ticket(tickets)
        if ticket >= views * blocks:
            break
        view = ticket // blocks
        gains_view, hidden_view = min(view, gains.shape[0] - 1), min(view, hidden.shape[0] - 1)
        first = ticket % blocks * CHUNK
        for place in range(first, min(first + CHUNK, count)):
            counts[view, place] = 0
            source = sources[place]
            if hidden[hidden_view, source]:
                continue
            head = heads[place]
            rect = _tiles_met(head[CENTER_X], head[CENTER_Y], head[HALF_WIDTH], head[HALF_HEIGHT], width, height)
            counts[view, place] = _write_rect(rects, view, place, rect)
            if counts[view, place] == 0:
                continue
            depths[view, place] = nearness[place]
            base = (view * counts.shape[1] + place) * stride
            for entry in range(HEAD):
                records[base + entry] = head[entry]
            for channel in range(channels):
                value = features[source, channel] * gains[gains_view, source]
                records[base + HEAD + channel] = value
                if not _finite(value):
                    refused[0] = 1
            _end_record(records, base, stride, channels, nearness[place])


@device
def _write_rect(rects, view, place, rect):
    """Note the tiles that a Gaussian meets; returns their number."""
    if rect[0] > rect[1] or rect[2] > rect[3]:
        return 0
    for side in range(4):
        rects[view, place, side] = rect[side]
    return (rect[1] - rect[0] + 1) * (rect[3] - rect[2] + 1)


@device
def _end_record(records, base, stride, channels, depth):
    """Fill a record behind its features."""
    records[base + HEAD + channels] = depth
    for rest in range(HEAD + channels + 1, stride):
        records[base + rest] = _ZERO


@device
def _tiles_met(center_x, center_y, half_x, half_y, width, height):
    """The tiles that an extent meets: first x, last x, first y, last y."""
    across, down = tiles_of(width, height)
    x0, x1 = _tile_range(center_x - half_x, center_x + half_x, TILE_WIDTH, across)
    y0, y1 = _tile_range(center_y - half_y, center_y + half_y, TILE_HEIGHT, down)
    return x0, x1, y0, y1


@device
def _before_camera(point, scale, lens, near):
    """Whether a Gaussian is beyond the near plane, and neither so far off nor so large that float32 ends."""
    largest = max(max(abs(point[0]), abs(point[1])), max(max(scale[0], scale[1]), scale[2]))
    return point[2] > near and largest * max(lens[0], lens[1]) < _FURTHEST * point[2]


@device
def _write_head(records, base, point, axes, opacity, rotation, lens, width, height):
    """Fill the head of a record; returns the tiles that it meets (first x, last x, first y, last y)."""
    _, _, row_x, row_y = _linearise(point, rotation, lens)
    p, q = apply_transposed(axes, row_x), apply_transposed(axes, row_y)
    pp, pq, qq = dot(p, p), dot(p, q), dot(q, q)
    normal = cross(p, q)
    # |p|²|q|² - (p.q)² = |p x q|²: the determinant without cancellation
    determinant = dot(normal, normal) + _BLUR * (pp + qq + _BLUR)
    var_x, var_y = pp + _BLUR, qq + _BLUR
    center_x = lens[0] * point[0] / point[2] + lens[2]
    center_y = lens[1] * point[1] / point[2] + lens[3]
    log2_opacity = math.log2(opacity)
    reach = _TWO * _MINUS_LN2 * (_LOG2_MIN_ALPHA - log2_opacity)  # square of the extent in standard deviations
    half_x, half_y = math.sqrt(reach * var_x) + _SLACK, math.sqrt(reach * var_y) + _SLACK
    inverse = _ONE / determinant
    records[base + CENTER_X] = center_x
    records[base + CENTER_Y] = center_y
    records[base + XX] = -_HALF * _LOG2_E * var_y * inverse
    records[base + XY] = _LOG2_E * pq * inverse
    records[base + YY] = -_HALF * _LOG2_E * var_x * inverse
    records[base + LOG2_OPACITY] = log2_opacity
    records[base + HALF_WIDTH] = half_x
    records[base + HALF_HEIGHT] = half_y
    return _tiles_met(center_x, center_y, half_x, half_y, width, height)


@kernel
def project_backward(
    tickets, means, quats, scales, opacities, camera_from_world, intrinsics, width, height,
    counts, offsets, sums, d_means, d_quats, d_scales, d_opacities, d_features, d_poses,
):  # fmt: skip
    """Add up each Gaussian's gradient slots and carry them to its parameters and to the poses.

    Gradients of shared tensors are summed over the views in their order. d_poses is `[blocks, b, 4, 4]`, one partial
    sum per chunk of Gaussians, so that its value does not depend on which thread took which chunk.
    """
    views, count = counts.shape
    blocks = (count + CHUNK - 1) // CHUNK
    while True:
        block = take_ticket(tickets)
        if block >= blocks:
            break
        for view in range(views):
            pose = _pose(camera_from_world, view)
            lens = _lens(intrinsics, view, width, height)
            features_view = min(view, d_features.shape[0] - 1)
            d_rotation = ((_ZERO, _ZERO, _ZERO), (_ZERO, _ZERO, _ZERO), (_ZERO, _ZERO, _ZERO))
            d_translation = (_ZERO, _ZERO, _ZERO)
            for index in range(block * CHUNK, min(block * CHUNK + CHUNK, count)):
                if counts[view, index] == 0:
                    continue
                slots = (offsets[view, index], offsets[view, index] + counts[view, index])
                first, second, d_depth = _sum_slots(sums, slots, d_features, features_view, index)
                mean = _triple(means, min(view, means.shape[0] - 1), index)
                scale = _triple(scales, min(view, scales.shape[0] - 1), index)
                quat, inverse = _unit_quat(quats, min(view, quats.shape[0] - 1), index)
                opacity = opacities[min(view, opacities.shape[0] - 1), index]
                d_mean, d_quat, d_scale, d_point, d_turn = _through_projection(
                    mean, scale, quat, inverse, pose, lens, first, second, d_depth
                )
                d_opacities[min(view, d_opacities.shape[0] - 1), index] += first[0] / opacity
                for axis in range(3):
                    d_means[min(view, d_means.shape[0] - 1), index, axis] += d_mean[axis]
                    d_scales[min(view, d_scales.shape[0] - 1), index, axis] += d_scale[axis]
                for axis in range(4):
                    d_quats[min(view, d_quats.shape[0] - 1), index, axis] += d_quat[axis]
                d_rotation = _add_outer(d_rotation, d_turn, d_point, mean)
                d_translation = add(d_translation, d_point)
            for row in range(3):
                for column in range(3):
                    d_poses[block, view, row, column] = d_rotation[row][column]
                d_poses[block, view, row, 3] = d_translation[row]


@device
def _sum_slots(sums, slots, d_features, view, index):
    """Add up the gradient slots of a Gaussian in one view; those of its features go to d_features at once.

    Returns:
        The first three moments, the other three, and the gradient of its depth.
    """
    first, second, d_depth = (_ZERO, _ZERO, _ZERO), (_ZERO, _ZERO, _ZERO), _ZERO
    channels = d_features.shape[2]
    for slot in range(slots[0], slots[1]):
        first = add(first, (sums[slot, 0], sums[slot, 1], sums[slot, 2]))
        second = add(second, (sums[slot, 3], sums[slot, 4], sums[slot, 5]))
        for channel in range(channels):
            d_features[view, index, channel] += sums[slot, MOMENTS + channel]
        d_depth += sums[slot, MOMENTS + channels]
    return first, second, d_depth


@device
def _add_outer(total, matrix, column, row):
    """Sum total + matrix + column row'."""
    return (
        add(total[0], add(matrix[0], scaled(column[0], row))),
        add(total[1], add(matrix[1], scaled(column[1], row))),
        add(total[2], add(matrix[2], scaled(column[2], row))),
    )


@device
def _through_projection(mean, scale, quat, inverse, pose, lens, first, second, d_depth):
    """Gradients of one Gaussian in one view.

    With g = dL / d log(alpha) and (sx, sy) the slope of log2(alpha) by the pixel's position, `first` holds the sums
    over pixels of g, g sx, g sy and `second` those of g sx², g sx sy, g sy².

    Returns:
        Gradients of mean, quat, scale, of the camera-space centre, and of the view's rotation by way of the
        covariance (rows).
    """
    rotation, translation = pose
    point = add(apply(rotation, mean), translation)
    turn = rotation_of(quat)
    axes = scale_columns(turn, scale)
    tangent, jacobian, row_x, row_y = _linearise(point, rotation, lens)
    p, q = apply_transposed(axes, row_x), apply_transposed(axes, row_y)

    # log(alpha) = const - d' Q d / 2 and its slope is -Q d: d log(alpha) / d centre = Q d and
    # d log(alpha) / d covariance = (Q d)(Q d)' / 2, twice which is what covariance = (p.p, p.q, q.q) takes
    d_center = (_MINUS_LN2 * first[1], _MINUS_LN2 * first[2])
    d_xx, d_xy, d_yy = scaled(_MINUS_LN2 * _MINUS_LN2, second)
    d_p, d_q = combined(d_xx, p, d_xy, q), combined(d_xy, p, d_yy, q)

    d_axes = (
        combined(row_x[0], d_p, row_y[0], d_q),
        combined(row_x[1], d_p, row_y[1], d_q),
        combined(row_x[2], d_p, row_y[2], d_q),
    )
    d_row_x, d_row_y = apply(axes, d_p), apply(axes, d_q)
    d_scale = add(times(d_axes[0], turn[0]), add(times(d_axes[1], turn[1]), times(d_axes[2], turn[2])))
    d_quat = rotation_gradient(quat, inverse, scale_columns(d_axes, scale))

    xx, xz, yy, yz = jacobian
    d_turn = (scaled(xx, d_row_x), scaled(yy, d_row_y), combined(xz, d_row_x, yz, d_row_y))
    d_point = _through_perspective(
        point, tangent, jacobian, _jacobian_gradient(rotation, d_row_x, d_row_y), d_center, d_depth
    )
    return apply_transposed(rotation, d_point), d_quat, d_scale, d_point, d_turn


@device
def _jacobian_gradient(rotation, d_row_x, d_row_y):
    """Gradients of the Jacobian's entries (xx, xz, yy, yz) from those of its rows in world axes."""
    return (
        dot(d_row_x, rotation[0]),
        dot(d_row_x, rotation[2]),
        dot(d_row_y, rotation[1]),
        dot(d_row_y, rotation[2]),
    )


@device
def _through_perspective(point, tangent, jacobian, d_jacobian, d_center, d_depth):
    """Gradient of the camera-space centre from those of the Jacobian's entries, the pixel position and the depth."""
    xx, xz, yy, yz = jacobian
    d_xx, d_xz, d_yy, d_yz = d_jacobian
    inverse_z = _ONE / point[2]
    slope_x, slope_y = point[0] * inverse_z, point[1] * inverse_z
    d_x, d_y = d_center[0] * xx, d_center[1] * yy
    d_z = d_depth - inverse_z * (d_xx * xx + d_xz * xz + d_yy * yy + d_yz * yz) - d_x * slope_x - d_y * slope_y
    if tangent[0] == slope_x:  # not clamped: the tangent moves with the point
        d_tangent = -xx * d_xz * inverse_z
        d_x, d_z = d_x + d_tangent, d_z - d_tangent * slope_x
    if tangent[1] == slope_y:
        d_tangent = -yy * d_yz * inverse_z
        d_y, d_z = d_y + d_tangent, d_z - d_tangent * slope_y
    return (d_x, d_y, d_z)
