"""Compiled image loops: colour, exact surface, visibility of points, covisibility.

Camera rays have z = 1 in the camera's frame, so the ray parameter of a hit is its z-depth.
"""

from typing import NamedTuple

import numpy as np

from lerobot_msdyn.synthetic.intersect import (
    BOX,
    CYLINDER,
    ELLIPSOID,
    Geometry,
    Vector,
    along,
    compiled,
    dot,
    face_axis,
    hit,
    inlined,
    local_point,
    nearest,
    outward_normal,
    rotate,
    rotate_back,
    row,
    unit,
    vector,
    world_point,
)

TILE = 8  # px; primitives are culled per tile
CLEARANCE = 2e-4  # m, start of a shadow ray above its surface
REUSE = 0.015  # m, the list of possible shadow casters is kept within this distance


class Appearance(NamedTuple):
    """Materials of P primitives, Q textures of L mip levels each, and the lamp; linear light."""

    side: np.ndarray  # [P] texture of box sides, cylinder walls and ellipsoids
    top: np.ndarray  # [P] texture of faces across the primitive's z axis, and of sheets
    gloss: np.ndarray  # [P] 0..1
    texels: np.ndarray  # [N, 3] float32, all textures in a row
    levels: np.ndarray  # [Q, L, 3] int64: first texel, height, width
    extent: np.ndarray  # [Q, 2] m, what one repetition of a texture covers in x and y
    lamp: np.ndarray  # [3] m, centre of a horizontal round lamp
    lamp_radius: float  # m
    lamp_points: np.ndarray  # [R, 3] m, places on the lamp that shadow rays go to


class Pinhole(NamedTuple):
    """One camera at one time (OpenCV axes)."""

    intrinsics: np.ndarray  # [3, 3] px
    rotation: np.ndarray  # [1, 3, 3] world from camera
    position: np.ndarray  # [3] m


class Cache(NamedTuple):
    """Lists of primitives that neighbouring pixels share."""

    candidates: np.ndarray  # [P] those that the tile's rays may meet
    casters: np.ndarray  # [P] those that may shade points near the anchor
    counts: np.ndarray  # [2] how many are in either list
    anchor: np.ndarray  # [3] m


Light = tuple[float, float, float, float]


@inlined
def _ray(camera: Pinhole, x: float, y: float) -> Vector:
    """World direction of the ray through a pixel position, at unit depth."""
    k = camera.intrinsics
    return rotate(camera.rotation, 0, ((x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], 1.0))


@compiled
def _cull(geometry: Geometry, camera: Pinhole, x0: int, y0: int, kept: np.ndarray) -> int:
    """Writes to `kept` the primitives that a tile's rays may meet and returns their number."""
    axis, corner = unit(_ray(camera, x0 + TILE / 2, y0 + TILE / 2)), 1.0
    for dx in (0, TILE):
        for dy in (0, TILE):
            corner = min(corner, dot(axis, unit(_ray(camera, x0 + dx, y0 + dy))))
    spread, eye, count = np.arccos(corner), vector(camera.position), 0
    for p in range(geometry.shape.shape[0]):
        offset = along(row(geometry.position, p), eye, -1.0)
        distance = np.sqrt(dot(offset, offset))
        near = distance <= geometry.radius[p]
        if near or np.arccos(dot(offset, axis) / distance) <= spread + np.arcsin(geometry.radius[p] / distance):
            kept[count] = p
            count += 1
    return count


@compiled
def _shadow_casters(geometry: Geometry, look: Appearance, point: Vector, kept: np.ndarray) -> int:
    """Writes to `kept` what may stand between the lamp and any point within REUSE of `point`."""
    toward, count = along(vector(look.lamp), point, -1.0), 0
    length = np.sqrt(dot(toward, toward))
    for p in range(geometry.shape.shape[0]):
        if not geometry.casts_shadow[p]:
            continue
        offset = along(row(geometry.position, p), point, -1.0)
        t = min(max(dot(offset, toward) / length**2, 0.0), 1.0)
        # rays from within REUSE of the point to anywhere on the lamp spread from REUSE to the lamp's radius
        far = min(1.0, t + (geometry.radius[p] + look.lamp_radius) / length)
        reach = geometry.radius[p] + max(REUSE, REUSE * (1 - far) + look.lamp_radius * far)
        miss = along(offset, toward, -t)
        if dot(miss, miss) <= reach**2:
            kept[count] = p
            count += 1
    return count


@inlined
def _lamp_light(
    geometry: Geometry, look: Appearance, casters: np.ndarray, count: int, point: Vector, normal: Vector
) -> float:
    """Light that a surface point receives from the lamp (Lambert, soft shadow), about 1 below the lamp."""
    start, received = along(point, normal, CLEARANCE), 0.0
    for i in range(look.lamp_points.shape[0]):
        toward = along(row(look.lamp_points, i), start, -1.0)
        facing = dot(toward, normal)
        if facing <= 0:
            continue
        blocked = False
        for j in range(count):
            if hit(geometry, casters[j], start, toward) < 1:
                # the next ray most likely ends at the same primitive
                blocked, casters[0], casters[j] = True, casters[j], casters[0]
                break
        if not blocked:
            square = dot(toward, toward)
            received += facing * look.lamp[2] ** 2 / (square * np.sqrt(square))
    return received / look.lamp_points.shape[0]


@inlined
def _illumination(look: Appearance, point: Vector, normal: Vector, view: Vector, lamp: float, gloss: float) -> Light:
    """What the albedo is multiplied by (r, g, b), from lamp, sky and a fill light, and the highlight to add."""
    sky = 0.27 + 0.13 * normal[2] + 0.16 * max(0.0, -0.55 * normal[0] - 0.65 * normal[1] + 0.5 * normal[2])
    shine = 0.0
    if lamp > 0 and gloss > 0:
        halfway = unit(along(unit(along(vector(look.lamp), point, -1.0)), unit(view), -1.0))
        shine = gloss * max(0.0, dot(halfway, normal)) ** 30 * min(lamp, 1.0)
    return lamp * 1.04 + sky * 0.96, lamp + sky, lamp * 0.92 + sky * 1.06, shine


@inlined
def _texel(look: Appearance, texture: int, x: float, y: float, footprint: float) -> Vector:
    """Bilinear colour of a texture at metres (x right, y up) from its centre, from the mip level of `footprint`."""
    size, level = look.extent[texture, 0] / look.levels[texture, 0, 2], 0
    while size * 1.5 < footprint and level < look.levels.shape[1] - 1:
        size, level = size * 2, level + 1
    levels = look.levels
    first, height, width = levels[texture, level, 0], levels[texture, level, 1], levels[texture, level, 2]
    u = (x / look.extent[texture, 0] + 0.5) * width - 0.5
    v = (0.5 - y / look.extent[texture, 1]) * height - 0.5
    i, j = int(np.floor(v)), int(np.floor(u))
    a, b = v - i, u - j
    color = (0.0, 0.0, 0.0)
    for di, wi in ((0, 1 - a), (1, a)):
        for dj, wj in ((0, 1 - b), (1, b)):
            index = first + (i + di) % height * width + (j + dj) % width
            color = along(color, row(look.texels, index), wi * wj)
    return color


@inlined
def _albedo(geometry: Geometry, look: Appearance, p: int, local: Vector, footprint: float) -> Vector:
    """Colour of a primitive at a point of its surface."""
    shape, half = geometry.shape[p], row(geometry.half, p)
    axis = face_axis(shape, half, local)
    if shape == BOX:
        if axis == 2:
            return _texel(look, look.top[p], local[0], local[1], footprint)
        return _texel(look, look.side[p], local[1 - axis], local[2], footprint)
    if shape == CYLINDER and axis == 2:
        return _texel(look, look.top[p], local[0], local[1], footprint)
    if shape in (CYLINDER, ELLIPSOID):
        turn = np.arctan2(local[0], -local[1])
        return _texel(look, look.side[p], turn * half[0], local[2], footprint)
    return _texel(look, look.top[p], local[0] - half[0] / 2, local[1] - half[1] / 2, footprint)


@inlined
def _encode(light: float) -> int:
    """8-bit display value of linear light, with a soft shoulder instead of clipping."""
    return int(255 * (1 - np.exp(-1.6 * light)) ** (1 / 2.2) + 0.5)


@inlined
def _pixel_light(geometry: Geometry, look: Appearance, camera: Pinhole, x: int, y: int, cache: Cache) -> Vector:
    """Linear light of one pixel: 2 x 2 samples, of which those on one smooth surface share the illumination."""
    eye, light, last, last_normal = vector(camera.position), (0.0, 0.0, 0.0), -1, (0.0, 0.0, 0.0)
    received = (0.0, 0.0, 0.0, 0.0)
    for sample in range(4):
        ray = _ray(camera, x + 0.25 + 0.5 * (sample % 2), y + 0.25 + 0.5 * (sample // 2))
        depth, p = nearest(geometry, cache.candidates, cache.counts[0], eye, ray)
        if p < 0:
            continue
        local, point = local_point(geometry, p, eye, ray, depth), along(eye, ray, depth)
        normal = outward_normal(geometry, p, local)
        if dot(normal, ray) > 0:
            normal = (-normal[0], -normal[1], -normal[2])
        if p != last or dot(normal, last_normal) < 0.99:
            moved = along(point, vector(cache.anchor), -1.0)
            if dot(moved, moved) > REUSE**2:
                cache.anchor[0], cache.anchor[1], cache.anchor[2] = point
                cache.counts[1] = _shadow_casters(geometry, look, point, cache.casters)
            lamp = _lamp_light(geometry, look, cache.casters, cache.counts[1], point, normal)
            received = _illumination(look, point, normal, ray, lamp, look.gloss[p])
            last, last_normal = p, normal
        color = _albedo(geometry, look, p, local, depth / camera.intrinsics[0, 0] / 2)
        shade = (
            color[0] * received[0] + received[3],
            color[1] * received[1] + received[3],
            color[2] * received[2] + received[3],
        )
        light = along(light, shade, 0.25)
    return light


@compiled
def trace_color(geometry: Geometry, look: Appearance, camera: Pinhole, rgb: np.ndarray) -> None:
    """Fills rgb uint8 [H, W, 3]; where a ray meets nothing it is black."""
    height, width = rgb.shape[:2]
    size = geometry.shape.shape[0]
    cache = Cache(np.empty(size, np.int64), np.empty(size, np.int64), np.zeros(2, np.int64), np.full(3, 1e9))
    for y0 in range(0, height, TILE):
        for x0 in range(0, width, TILE):
            cache.counts[0] = _cull(geometry, camera, x0, y0, cache.candidates)
            for y in range(y0, min(y0 + TILE, height)):
                for x in range(x0, min(x0 + TILE, width)):
                    light = _pixel_light(geometry, look, camera, x, y, cache)
                    for channel in range(3):
                        rgb[y, x, channel] = _encode(light[channel])


@compiled
def trace_surface(
    geometry: Geometry, camera: Pinhole, depth: np.ndarray, primitive: np.ndarray, local: np.ndarray
) -> None:
    """Fills z-depth float32 [H, W] (0 = nothing), primitive int16 [H, W] (-1) and local point float32 [H, W, 3]."""
    height, width = depth.shape
    kept, eye = np.empty(geometry.shape.shape[0], np.int64), vector(camera.position)
    for y0 in range(0, height, TILE):
        for x0 in range(0, width, TILE):
            count = _cull(geometry, camera, x0, y0, kept)
            for y in range(y0, min(y0 + TILE, height)):
                for x in range(x0, min(x0 + TILE, width)):
                    ray = _ray(camera, x + 0.5, y + 0.5)
                    t, p = nearest(geometry, kept, count, eye, ray)
                    primitive[y, x], depth[y, x] = p, 0.0
                    if p >= 0:
                        depth[y, x] = t
                        point = local_point(geometry, p, eye, ray, t)
                        local[y, x, 0], local[y, x, 1], local[y, x, 2] = point


@compiled
def see_points(
    geometry: Geometry, camera: Pinhole, primitive: np.ndarray, local: np.ndarray, points: np.ndarray, seen: np.ndarray
) -> None:
    """Places surface points [N] of primitives in the world (points [N, 3]); seen [N]: nothing stands before them."""
    everything, eye = np.arange(geometry.shape.shape[0]), vector(camera.position)
    for n in range(primitive.shape[0]):
        point = world_point(geometry, primitive[n], row(local, n))
        points[n, 0], points[n, 1], points[n, 2] = point
        ray = along(point, eye, -1.0)
        t, _ = nearest(geometry, everything, everything.shape[0], eye, ray)
        seen[n] = t > 1 - 1e-3


@inlined
def _sees(camera: Pinhole, depth: np.ndarray, point: Vector, tolerance: float) -> bool:
    """Whether a world point is at or before the recorded depth of the pixels around its projection."""
    x, y, z = rotate_back(camera.rotation, 0, along(point, vector(camera.position), -1.0))
    if z <= 0:
        return False
    k = camera.intrinsics
    u, v = k[0, 0] * x / z + k[0, 2] - 0.5, k[1, 1] * y / z + k[1, 2] - 0.5
    i, j = int(np.floor(v)), int(np.floor(u))
    if i < 0 or j < 0 or i + 1 >= depth.shape[0] or j + 1 >= depth.shape[1]:
        return False
    return z <= max(depth[i, j], depth[i + 1, j], depth[i, j + 1], depth[i + 1, j + 1]) + tolerance


@compiled
def mark_covisible(
    geometry: Geometry,
    camera: Pinhole,
    depth: np.ndarray,
    primitive: np.ndarray,
    local: np.ndarray,
    covis: np.ndarray,
    value: int,
) -> None:
    """Sets covis [H, W] to `value` where still 0 and where the surface point is seen in a recorded frame.

    `primitive` and `local` are the surface of the new view; `geometry`, `camera` and `depth` those of the recorded
    frame, whose time may be another: points move with their primitive.
    """
    for y in range(covis.shape[0]):
        for x in range(covis.shape[1]):
            if covis[y, x] == 0 and primitive[y, x] >= 0:
                point = world_point(geometry, primitive[y, x], (local[y, x, 0], local[y, x, 1], local[y, x, 2]))
                if _sees(camera, depth, point, 0.003):
                    covis[y, x] = value
