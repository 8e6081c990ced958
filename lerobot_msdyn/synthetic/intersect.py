"""Rays against the four shapes of a synthetic scene: compiled, exact, without any sampling.

A ray is origin + t * direction; directions need not be unit vectors. Every `_hit_*` function returns the smallest
t > EPSILON at which the ray meets the surface, or infinity.
"""

from typing import NamedTuple

import numpy as np

from lerobot_msdyn.core.compiled import compiled, inlined

BOX, CYLINDER, ELLIPSOID, SHEET = 0, 1, 2, 3
EPSILON = 1e-9
INFINITY = np.inf

Vector = tuple[float, float, float]


class Geometry(NamedTuple):
    """The primitives of one frame as arrays (P primitives, a sheet of S segments); float64, metres."""

    shape: np.ndarray  # [P] int64, one of BOX, CYLINDER, ELLIPSOID, SHEET
    half: np.ndarray  # [P, 3] half extents; of a cylinder (radius, radius, half height); of a sheet (length, width)
    radius: np.ndarray  # [P] of the bounding sphere about the position
    position: np.ndarray  # [P, 3] origin of the primitive in the world
    rotation: np.ndarray  # [P, 3, 3] world from primitive
    casts_shadow: np.ndarray  # [P] bool
    sheet_nodes: np.ndarray  # [S + 1, 3] one long edge of the sheet, evenly spaced in arc length
    sheet_across: np.ndarray  # [3] from this edge to the other


@inlined
def dot(a: Vector, b: Vector) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def along(origin: Vector, direction: Vector, t: float) -> Vector:
    """The point origin + t * direction."""
    return origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2]


@inlined
def unit(a: Vector) -> Vector:
    """The vector at length one."""
    scale = 1 / np.sqrt(dot(a, a))
    return a[0] * scale, a[1] * scale, a[2] * scale


@inlined
def row(points: np.ndarray, index: int) -> Vector:
    """One row of an [N, 3] array."""
    return points[index, 0], points[index, 1], points[index, 2]


@inlined
def vector(a: np.ndarray) -> Vector:
    """An array of three numbers."""
    return a[0], a[1], a[2]


@inlined
def rotate(m: np.ndarray, k: int, v: Vector) -> Vector:
    """The product m[k] @ v; taking the slice m[k] here would cost more than the product."""
    return (
        m[k, 0, 0] * v[0] + m[k, 0, 1] * v[1] + m[k, 0, 2] * v[2],
        m[k, 1, 0] * v[0] + m[k, 1, 1] * v[1] + m[k, 1, 2] * v[2],
        m[k, 2, 0] * v[0] + m[k, 2, 1] * v[1] + m[k, 2, 2] * v[2],
    )


@inlined
def rotate_back(m: np.ndarray, k: int, v: Vector) -> Vector:
    """The product m[k].T @ v."""
    return (
        m[k, 0, 0] * v[0] + m[k, 1, 0] * v[1] + m[k, 2, 0] * v[2],
        m[k, 0, 1] * v[0] + m[k, 1, 1] * v[1] + m[k, 2, 1] * v[2],
        m[k, 0, 2] * v[0] + m[k, 1, 2] * v[1] + m[k, 2, 2] * v[2],
    )


@inlined
def _slab(origin: float, direction: float, half: float) -> tuple[float, float]:
    """The part of a ray with |coordinate| <= half."""
    a, b = (-half - origin) / direction, (half - origin) / direction
    return min(a, b), max(a, b)


@inlined
def _first(enter: float, leave: float) -> float:
    """First boundary of an interval of a ray in front of its origin (the far one if the origin is inside)."""
    if enter > leave or leave <= EPSILON:
        return INFINITY
    return enter if enter > EPSILON else leave


@inlined
def _hit_box(o: Vector, d: Vector, half: Vector) -> float:
    x0, x1 = _slab(o[0], d[0], half[0])
    y0, y1 = _slab(o[1], d[1], half[1])
    z0, z1 = _slab(o[2], d[2], half[2])
    return _first(max(x0, y0, z0), min(x1, y1, z1))


@inlined
def _quadratic(a: float, b: float, c: float) -> tuple[float, float]:
    """The interval in which a t^2 + 2 b t + c <= 0, for a >= 0."""
    if a < 1e-18:
        return (-INFINITY, INFINITY) if c <= 0 else (INFINITY, -INFINITY)
    discriminant = b * b - a * c
    if discriminant < 0:
        return INFINITY, -INFINITY
    root = np.sqrt(discriminant)
    return (-b - root) / a, (-b + root) / a


@inlined
def _hit_cylinder(o: Vector, d: Vector, half: Vector) -> float:
    t0, t1 = _quadratic(
        d[0] * d[0] + d[1] * d[1], o[0] * d[0] + o[1] * d[1], o[0] * o[0] + o[1] * o[1] - half[0] * half[0]
    )
    z0, z1 = _slab(o[2], d[2], half[2])
    return _first(max(t0, z0), min(t1, z1))


@inlined
def _hit_ellipsoid(o: Vector, d: Vector, half: Vector) -> float:
    p = (o[0] / half[0], o[1] / half[1], o[2] / half[2])
    q = (d[0] / half[0], d[1] / half[1], d[2] / half[2])
    t0, t1 = _quadratic(dot(q, q), dot(p, q), dot(p, p) - 1)
    return _first(t0, t1)


@inlined
def _sheet_edges(geometry: Geometry, segment: int) -> tuple[Vector, Vector]:
    """Lengthwise and widthwise edge of one flat segment of the sheet."""
    nodes, across = geometry.sheet_nodes, geometry.sheet_across
    start = row(nodes, segment)
    return along(row(nodes, segment + 1), start, -1.0), vector(across)


@compiled
def _hit_sheet(geometry: Geometry, o: Vector, d: Vector) -> tuple[float, int, float, float]:
    """Returns t, segment and fractions along and across the segment of the nearest hit of a chain of rectangles."""
    best, where, fraction_along, fraction_across = INFINITY, 0, 0.0, 0.0
    for segment in range(geometry.sheet_nodes.shape[0] - 1):
        a, b = _sheet_edges(geometry, segment)
        normal = cross(a, b)
        slope = dot(normal, d)
        if slope == 0:
            continue
        to_start = along(row(geometry.sheet_nodes, segment), o, -1.0)
        t = dot(normal, to_start) / slope
        if t <= EPSILON or t >= best:
            continue
        offset = along(along((0.0, 0.0, 0.0), d, t), to_start, -1.0)
        u, v = dot(offset, a) / dot(a, a), dot(offset, b) / dot(b, b)
        if 0 <= u <= 1 and 0 <= v <= 1:
            best, where, fraction_along, fraction_across = t, segment, u, v
    return best, where, fraction_along, fraction_across


@inlined
def hit(geometry: Geometry, p: int, origin: Vector, direction: Vector) -> float:
    """Where a ray first meets primitive p."""
    o = along(origin, row(geometry.position, p), -1.0)
    toward, reach = dot(o, direction), dot(o, o) - geometry.radius[p] ** 2
    if reach > 0 and (toward > 0 or toward * toward < reach * dot(direction, direction)):
        return INFINITY
    if geometry.shape[p] == SHEET:
        return _hit_sheet(geometry, origin, direction)[0]
    half = row(geometry.half, p)
    local_o, local_d = rotate_back(geometry.rotation, p, o), rotate_back(geometry.rotation, p, direction)
    if geometry.shape[p] == BOX:
        return _hit_box(local_o, local_d, half)
    if geometry.shape[p] == CYLINDER:
        return _hit_cylinder(local_o, local_d, half)
    return _hit_ellipsoid(local_o, local_d, half)


@inlined
def nearest(
    geometry: Geometry, candidates: np.ndarray, count: int, origin: Vector, direction: Vector
) -> tuple[float, int]:
    """The first primitive that a ray meets among `count` candidates, as (t, index); (infinity, -1) if none."""
    best, index = INFINITY, -1
    for i in range(count):
        t = hit(geometry, candidates[i], origin, direction)
        if t < best:
            best, index = t, candidates[i]
    return best, index


@inlined
def local_point(geometry: Geometry, p: int, origin: Vector, direction: Vector, t: float) -> Vector:
    """The surface point of a hit in the primitive's frame; on the sheet (metres along, metres across, 0)."""
    if geometry.shape[p] == SHEET:
        _, segment, u, v = _hit_sheet(geometry, origin, direction)
        segments = geometry.sheet_nodes.shape[0] - 1
        return (segment + u) / segments * geometry.half[p, 0], v * geometry.half[p, 1], 0.0
    point = along(along(origin, direction, t), row(geometry.position, p), -1.0)
    return rotate_back(geometry.rotation, p, point)


@inlined
def world_point(geometry: Geometry, p: int, local: Vector) -> Vector:
    """Inverse of `local_point`: where a point of a primitive's surface is in the world."""
    if geometry.shape[p] != SHEET:
        return along(row(geometry.position, p), rotate(geometry.rotation, p, local), 1.0)
    segments = geometry.sheet_nodes.shape[0] - 1
    place = local[0] / geometry.half[p, 0] * segments
    segment = min(max(int(place), 0), segments - 1)
    a, b = _sheet_edges(geometry, segment)
    start = row(geometry.sheet_nodes, segment)
    return along(along(start, a, place - segment), b, local[1] / geometry.half[p, 1])


@inlined
def face_axis(shape: int, half: Vector, local: Vector) -> int:
    """Which face of a box (0, 1, 2 = x, y, z) or cylinder (0 = side, 2 = cap) a surface point lies on."""
    if shape == BOX:
        x, y, z = abs(local[0]) / half[0], abs(local[1]) / half[1], abs(local[2]) / half[2]
        if z >= x and z >= y:
            return 2
        return 0 if x >= y else 1
    if shape == CYLINDER:
        return 2 if half[2] - abs(local[2]) < half[0] - np.sqrt(local[0] ** 2 + local[1] ** 2) else 0
    return 2 if shape == SHEET else 0


@inlined
def outward_normal(geometry: Geometry, p: int, local: Vector) -> Vector:
    """Unit normal of the surface in the world (of the sheet: its upper side when flat)."""
    shape, half = geometry.shape[p], row(geometry.half, p)
    if shape == SHEET:
        segments = geometry.sheet_nodes.shape[0] - 1
        segment = min(max(int(local[0] / half[0] * segments), 0), segments - 1)
        a, b = _sheet_edges(geometry, segment)
        return unit(cross(a, b))
    if shape == ELLIPSOID:
        normal = unit((local[0] / half[0] ** 2, local[1] / half[1] ** 2, local[2] / half[2] ** 2))
        return rotate(geometry.rotation, p, normal)
    axis = face_axis(shape, half, local)
    if shape == CYLINDER and axis == 0:
        return rotate(geometry.rotation, p, unit((local[0], local[1], 0.0)))
    sign = 1.0 if local[axis] > 0 else -1.0
    normal = (sign if axis == 0 else 0.0, sign if axis == 1 else 0.0, sign if axis == 2 else 0.0)
    return rotate(geometry.rotation, p, normal)
