# mypy: disable-error-code="no-untyped-def"
"""Compiled loops of the registration: points against what a frame shows, and Gauss-Newton steps of rigid parts.

Everything is in the axes of the camera, in m. numba looks for changes in this file only.
"""

import math
from typing import NamedTuple

import numpy as np

from lerobot_msdyn.core.compiled import compiled, inlined
from lerobot_msdyn.render.cpu.simd import take_ticket

REACH_PX = 2  # to either side, over which normals are taken, and 1 for gradients
OUTSIDE_UNIT = 8  # steps per px of the distance outside the masks
BEHIND_PX = 8.0  # a point farther than this from the recorded surface is hidden, or the surface is another one
IN_FRONT_PX = 3.0  # a point no farther than this behind what stands still should have been seen
FACING = 0.2  # least cosine between a normal and the view
ALIKE = 0.5  # least cosine between the normals of a point and of the surface that it meets
OUTLINE_PX = 8.0  # of 320: farther outside the masks a point tells nothing
SIGMAS = (0.5, 8.0, 1.0)  # px of depth, grey levels, px outside the masks
OUTLIER = 3.0  # sigmas at which three quarters of the weight are lost (Geman-McClure)
CORRELATED = 8.0  # neighbouring points, which err alike and count as one
LEAST_CURVATURE = 1e-9  # of the normal equations, where nothing is seen or held
UNSEEN = 0.5  # cost of a frame that tells nothing of a point, between those of agreement and of contradiction

NOTHING, MET, STRAY, IN_FRONT = 0, 1, 2, 3


class Maps(NamedTuple):
    """What t frames show."""

    depth: np.ndarray  # [t,h,w] m, float32
    reliable: np.ndarray  # [t,h,w] bool, where depth and normals can be relied on
    grey: np.ndarray  # [t,h,w] uint8
    outside: np.ndarray  # [t,h,w] uint8, distance from the nearest moving pixel, eighths of a px of 320
    intrinsics: np.ndarray  # [t,3,3] float32, px
    pixel_m: float  # size of a pixel of a picture 320 wide, where things move


class Points(NamedTuple):
    """Points of the parts at the canonical frame, sorted by part."""

    xyz: np.ndarray  # [n,3] m, float32, in the world
    normals: np.ndarray  # [n,3] float32
    grey: np.ndarray  # [n] float32
    first: np.ndarray  # [k+1] int64, the first point of each part


@inlined
def _surface(maps, t, row, column):
    """Recorded point and unit normal (towards the camera) of a pixel."""
    k = maps.intrinsics[t]
    height, width = maps.depth.shape[1:]
    left, right = max(column - REACH_PX, 0), min(column + REACH_PX, width - 1)
    up, down = max(row - REACH_PX, 0), min(row + REACH_PX, height - 1)
    z_l, z_r, z_u, z_d = (
        maps.depth[t, row, left],
        maps.depth[t, row, right],
        maps.depth[t, up, column],
        maps.depth[t, down, column],
    )
    u, v = (column + 0.5 - k[0, 2]) / k[0, 0], (row + 0.5 - k[1, 2]) / k[1, 1]
    ax, ay, az = (
        z_r * (right + 0.5 - k[0, 2]) / k[0, 0] - z_l * (left + 0.5 - k[0, 2]) / k[0, 0],
        (z_r - z_l) * v,
        z_r - z_l,
    )
    bx, by, bz = (
        (z_d - z_u) * u,
        z_d * (down + 0.5 - k[1, 2]) / k[1, 1] - z_u * (up + 0.5 - k[1, 2]) / k[1, 1],
        z_d - z_u,
    )
    nx, ny, nz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
    length = max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
    z = maps.depth[t, row, column]
    return z * u, z * v, z, nx / length, ny / length, nz / length


@inlined
def _slopes(image, t, row, column):
    """Central differences by x and y, per px."""
    height, width = image.shape[1:]
    left, right = max(column - 1, 0), min(column + 1, width - 1)
    up, down = max(row - 1, 0), min(row + 1, height - 1)
    x = (float(image[t, row, right]) - float(image[t, row, left])) / (right - left)
    y = (float(image[t, down, column]) - float(image[t, up, column])) / (down - up)
    return x, y


@inlined
def _compare(maps, t, x, y, z, nx, ny, nz, out):
    """What a frame says of a point: MET, STRAY, IN_FRONT or NOTHING.

    `out`: pixel row and column, distance from the surface along its normal (m), that normal, px from the pixel's
    centre; all but the first two only where a surface is met.
    """
    if z <= 1e-6:
        return NOTHING
    k = maps.intrinsics[t]
    px, py = k[0, 0] * x / z + k[0, 2], k[1, 1] * y / z + k[1, 2]
    height, width = maps.depth.shape[1:]
    if not (0 <= px < width and 0 <= py < height):
        return NOTHING
    if -(x * nx + y * ny + z * nz) <= FACING * math.sqrt(x * x + y * y + z * z):
        return NOTHING
    column, row = int(px), int(py)
    out[0], out[1] = row, column
    recorded = maps.depth[t, row, column]
    outside = maps.outside[t, row, column]
    if outside > 0:
        seen = recorded == 0 or z < recorded + IN_FRONT_PX * maps.pixel_m
        return STRAY if seen and outside < OUTLINE_PX * OUTSIDE_UNIT else NOTHING
    if not maps.reliable[t, row, column]:
        return NOTHING
    sx, sy, sz, mx, my, mz = _surface(maps, t, row, column)
    if z < recorded - BEHIND_PX * maps.pixel_m:
        return IN_FRONT
    near = (x - sx) ** 2 + (y - sy) ** 2 + (z - sz) ** 2 < (BEHIND_PX * maps.pixel_m) ** 2
    if not near or mx * nx + my * ny + mz * nz <= ALIKE:
        return NOTHING
    out[2] = mx * (x - sx) + my * (y - sy) + mz * (z - sz)
    out[3], out[4], out[5] = mx, my, mz
    out[6], out[7] = px - column - 0.5, py - row - 0.5
    return MET


@compiled
def frame_costs(tickets, points, normals, grey, frames, maps, costs):
    """How badly points fit frames, 0 to 1 each: `costs` [f,n] of points and normals [f,n,3] in the camera, grey [n].

    A ticket is a frame.
    """
    out = np.zeros(8)
    f = take_ticket(tickets)
    while f < len(frames):
        t = frames[f]
        for i in range(points.shape[1]):
            costs[f, i] = UNSEEN
            x, y, z = points[f, i]
            nx, ny, nz = normals[f, i]
            outcome = _compare(maps, t, x, y, z, nx, ny, nz, out)
            if outcome == NOTHING:
                continue
            row, column = int(out[0]), int(out[1])
            if outcome == MET:
                gx, gy = _slopes(maps.grey, t, row, column)
                colour = (maps.grey[t, row, column] + gx * out[6] + gy * out[7] - grey[i]) / SIGMAS[1]
                square = (out[2] / (SIGMAS[0] * maps.pixel_m)) ** 2 + colour**2
            elif outcome == STRAY:
                square = (maps.outside[t, row, column] / (OUTSIDE_UNIT * SIGMAS[2])) ** 2 + OUTLIER**2
            else:
                square = 1e6
            costs[f, i] = square / (OUTLIER**2 + square)
        f = take_ticket(tickets)


@inlined
def _solve6(a, b):
    """Solve a x = b in place, a symmetric and positive definite [6,6]."""
    for i in range(6):
        for j in range(i + 1):
            s = a[i, j]
            for m in range(j):
                s -= a[i, m] * a[j, m]
            a[i, j] = math.sqrt(max(s, 1e-30)) if i == j else s / a[j, j]
    for i in range(6):
        for m in range(i):
            b[i] -= a[i, m] * b[m]
        b[i] /= a[i, i]
    for i in range(5, -1, -1):
        for m in range(i + 1, 6):
            b[i] -= a[m, i] * b[m]
        b[i] /= a[i, i]


@inlined
def _add(hessian, slope, weight, residual, gradient, arm, scale):
    """One residual with its gradient by the point, in the normal equations of a turn (in m) and a shift."""
    row = (
        (arm[1] * gradient[2] - arm[2] * gradient[1]) * scale,
        (arm[2] * gradient[0] - arm[0] * gradient[2]) * scale,
        (arm[0] * gradient[1] - arm[1] * gradient[0]) * scale,
        gradient[0],
        gradient[1],
        gradient[2],
    )
    for i in range(6):
        slope[i] += weight * residual * row[i]
        for j in range(i + 1):
            hessian[i, j] += weight * row[i] * row[j]


@inlined
def _product(a, b):
    """Product of two matrices [3,3]."""
    out = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    return out


@inlined
def _placed(a, b):
    """Product of a matrix [3,3] and a point [3]."""
    out = np.zeros(3)
    for i in range(3):
        out[i] = a[i, 0] * b[0] + a[i, 1] * b[1] + a[i, 2] * b[2]
    return out


@inlined
def _turned(rotation, step):
    """A rotation after a turn by a rotation vector, all [3,3] and [3]."""
    angle = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    s = math.sin(angle) / angle if angle > 1e-9 else 1.0
    c = (1 - math.cos(angle)) / angle**2 if angle > 1e-9 else 0.5
    x, y, z = step[0], step[1], step[2]
    turn = np.array(
        [
            [1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y],
            [c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x],
            [c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)],
        ]
    )
    return _product(turn, rotation)


@inlined
def _look(points, first, last, pose, maps, t, status, terms):
    """Compare some points with a frame; returns their mean difference of grey values.

    `terms` become those of `_compare`, with the colour's gradient in place of the last two, the point in the camera,
    and the difference of grey values.
    """
    mean, count = 0.0, 0
    for i in range(first, last):
        p, m = points.xyz[i], points.normals[i]
        x = pose[0, 0] * p[0] + pose[0, 1] * p[1] + pose[0, 2] * p[2] + pose[0, 3]
        y = pose[1, 0] * p[0] + pose[1, 1] * p[1] + pose[1, 2] * p[2] + pose[1, 3]
        z = pose[2, 0] * p[0] + pose[2, 1] * p[1] + pose[2, 2] * p[2] + pose[2, 3]
        nx = pose[0, 0] * m[0] + pose[0, 1] * m[1] + pose[0, 2] * m[2]
        ny = pose[1, 0] * m[0] + pose[1, 1] * m[1] + pose[1, 2] * m[2]
        nz = pose[2, 0] * m[0] + pose[2, 1] * m[1] + pose[2, 2] * m[2]
        status[i] = _compare(maps, t, x, y, z, nx, ny, nz, terms[i])
        terms[i, 8], terms[i, 9], terms[i, 10] = x, y, z
        if status[i] == MET:
            row, column = int(terms[i, 0]), int(terms[i, 1])
            gx, gy = _slopes(maps.grey, t, row, column)
            terms[i, 11] = maps.grey[t, row, column] + gx * terms[i, 6] + gy * terms[i, 7] - points.grey[i]
            terms[i, 6], terms[i, 7] = gx, gy
            mean += terms[i, 11]
            count += 1
    return mean / max(count, 1)


@inlined
def _add_point(hessian, slope, outcome, term, mean, pivot, unit, maps, t):
    """The residuals of one point, by the `outcome` of its comparison."""
    k = maps.intrinsics[t]
    x, y, z = term[8], term[9], term[10]
    arm = (x - pivot[0], y - pivot[1], z - pivot[2])
    if outcome == MET:
        sigma = SIGMAS[0] * maps.pixel_m
        residual = term[2] / sigma
        weight = 1 / (1 + (residual / OUTLIER) ** 2) ** 2 / CORRELATED
        _add(hessian, slope, weight, residual, (term[3] / sigma, term[4] / sigma, term[5] / sigma), arm, unit)
        residual = (term[11] - mean) / SIGMAS[1]
        weight = 1 / (1 + (residual / OUTLIER) ** 2) ** 2 / CORRELATED
        gx, gy = term[6] / SIGMAS[1], term[7] / SIGMAS[1]
    else:
        row, column = int(term[0]), int(term[1])
        residual = maps.outside[t, row, column] / (OUTSIDE_UNIT * SIGMAS[2])
        weight = 1 / CORRELATED
        gx, gy = _slopes(maps.outside, t, row, column)
        gx, gy = gx / (OUTSIDE_UNIT * SIGMAS[2]), gy / (OUTSIDE_UNIT * SIGMAS[2])
    gx, gy = gx * k[0, 0] / z, gy * k[1, 1] / z
    _add(hessian, slope, weight, residual, (gx, gy, -(gx * x + gy * y) / z), arm, unit)


@inlined
def _add_hold(hessian, slope, hold, pose, held, middle, unit):
    """The pull of a pose to another one; `middle` is the part's pivot at the canonical frame."""
    turn = _product(pose, held[:3, :3].T)
    gone = _placed(pose, middle) + pose[:3, 3] - _placed(held, middle) - held[:3, 3]
    slope[0] += hold * (turn[2, 1] - turn[1, 2]) / 2 / unit
    slope[1] += hold * (turn[0, 2] - turn[2, 0]) / 2 / unit
    slope[2] += hold * (turn[1, 0] - turn[0, 1]) / 2 / unit
    for i in range(3):
        slope[3 + i] += hold * gone[i]
    for i in range(6):
        hessian[i, i] += hold


@compiled
def align_poses(tickets, poses, held, hold, pivots, reach, points, maps, steps, longest):
    """Gauss-Newton steps of poses (camera from canonical) [k,t,4,4], float64, in place; a ticket is a frame.

    Each is pulled to the pose in `held` (the same shape) with the weight `hold` (1/m^2, of a turn times the part's
    `reach` and of the shift of its pivot). Steps are `longest` (m) at most.
    """
    status, terms = np.zeros(len(points.xyz), np.int64), np.zeros((len(points.xyz), 12))
    t = take_ticket(tickets)
    while t < poses.shape[1]:
        for part in range(poses.shape[0]):
            first, last = points.first[part], points.first[part + 1]
            unit = 1 / reach[part]
            pose = poses[part, t]
            for _ in range(steps):
                mean = _look(points, first, last, pose, maps, t, status, terms)
                pivot = _placed(pose, pivots[part]) + pose[:3, 3]
                hessian, step = np.zeros((6, 6)), np.zeros(6)
                for i in range(first, last):
                    if status[i] == MET or status[i] == STRAY:
                        _add_point(hessian, step, status[i], terms[i], mean, pivot, unit, maps, t)
                _add_hold(hessian, step, hold, pose, held[part, t], pivots[part], unit)
                for i in range(6):
                    hessian[i, i] += LEAST_CURVATURE
                _solve6(hessian, step)
                for i in range(6):
                    step[i] = -min(max(step[i], -longest), longest)
                rotation = _turned(pose[:3, :3], step[:3] * unit)
                pose[:3, :3] = rotation
                pose[:3, 3] = pivot + step[3:] - _placed(rotation, pivots[part])
        t = take_ticket(tickets)
