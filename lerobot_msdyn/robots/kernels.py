"""Compiled loops: depth of triangles, coverage of points."""

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32
from numpy import ndarray

from lerobot_msdyn.core.compiled import compiled


@compiled
def draw_triangles(
    points: Float64[ndarray, "v 3"],
    faces: Int32[ndarray, "f 3"],
    focal: float,
    cx: float,
    cy: float,
    depth: Float32[ndarray, "h w"],
    index: Int32[ndarray, "h w"],
) -> None:
    """Z-buffer of triangles given in the camera's frame: where they are nearer than `depth`, it and `index` (the face)
    are replaced. Triangles that reach behind 1 cm are left out.
    """
    height, width = depth.shape
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        za, zb, zc = points[a, 2], points[b, 2], points[c, 2]
        if za < 0.01 or zb < 0.01 or zc < 0.01:
            continue
        xa, ya = focal * points[a, 0] / za + cx - 0.5, focal * points[a, 1] / za + cy - 0.5
        xb, yb = focal * points[b, 0] / zb + cx - 0.5, focal * points[b, 1] / zb + cy - 0.5
        xc, yc = focal * points[c, 0] / zc + cx - 0.5, focal * points[c, 1] / zc + cy - 0.5
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        if area == 0.0:
            continue
        left, right = min(xa, xb, xc), max(xa, xb, xc)
        top, bottom = min(ya, yb, yc), max(ya, yb, yc)
        if right < 0 or bottom < 0 or left > width - 1 or top > height - 1:
            continue
        x0, x1 = max(0, int(np.ceil(left))), min(width - 1, int(np.floor(right)))
        y0, y1 = max(0, int(np.ceil(top))), min(height - 1, int(np.floor(bottom)))
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                wa = ((xb - x) * (yc - y) - (xc - x) * (yb - y)) / area
                wb = ((xc - x) * (ya - y) - (xa - x) * (yc - y)) / area
                wc = 1.0 - wa - wb
                if wa < 0 or wb < 0 or wc < 0:
                    continue
                z = 1.0 / (wa / za + wb / zb + wc / zc)
                if z < depth[y, x]:
                    depth[y, x] = z
                    index[y, x] = face


@compiled
def place_vertices(
    vertices: Float32[ndarray, "v 3"],
    link: Int32[ndarray, " v"],
    camera_from_link: Float64[ndarray, "l 4 4"],
    out: Float64[ndarray, "v 3"],
) -> None:
    """Vertices in the camera's frame, m."""
    for v in range(vertices.shape[0]):
        pose, x, y, z = camera_from_link[link[v]], vertices[v, 0], vertices[v, 1], vertices[v, 2]
        for k in range(3):
            out[v, k] = pose[k, 0] * x + pose[k, 1] * y + pose[k, 2] * z + pose[k, 3]


@compiled
def trace_edges(
    index: Int32[ndarray, "h w"],
    depth: Float32[ndarray, "h w"],
    face_link: Int32[ndarray, " f"],
    wanted: Bool[ndarray, " l"],
    out: Float64[ndarray, "n 4"],
) -> int:
    """Between pixels of wanted links and neighbours that show none: x, y (px), z (m) and link; returns their number."""
    height, width = index.shape
    count = 0
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            if index[i, j] < 0:
                continue
            link = face_link[index[i, j]]
            if not wanted[link]:
                continue
            for side in range(4):
                down = (side == 0) - (side == 1)
                right = (side == 2) - (side == 3)
                if index[i + down, j + right] < 0 and count < out.shape[0]:
                    out[count, 0] = j + 0.5 + 0.5 * right
                    out[count, 1] = i + 0.5 + 0.5 * down
                    out[count, 2] = depth[i, j]
                    out[count, 3] = link
                    count += 1
    return count


@compiled
def cover(
    points: Float32[ndarray, "t n 3"],
    rotation: Float64[ndarray, "3 3"],
    translation: Float64[ndarray, "3"],
    focal: float,
    cx: float,
    cy: float,
    weight: float,
    out: Float32[ndarray, "h w t"],
) -> None:
    """Share of every cell that points of a surface cover, each spread over the four nearest cells."""
    height, width, frames = out.shape
    out[:] = 0
    r, s = rotation, translation
    for t in range(frames):
        for n in range(points.shape[1]):
            px, py, pz = points[t, n, 0], points[t, n, 1], points[t, n, 2]
            z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + s[2]
            if z < 0.02:
                continue
            x = focal * (r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + s[0]) / z + cx - 0.5
            y = focal * (r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + s[1]) / z + cy - 0.5
            if not (-1 < x < width and -1 < y < height):
                continue
            column, row = int(np.floor(x)), int(np.floor(y))
            fx, fy = x - column, y - row
            for dy in range(2):
                for dx in range(2):
                    i, j = row + dy, column + dx
                    if 0 <= i < height and 0 <= j < width:
                        share = (fy if dy else 1 - fy) * (fx if dx else 1 - fx)
                        out[i, j, t] = min(np.float32(1.0), out[i, j, t] + np.float32(weight * share))


@compiled
def agreement(centred: Float32[ndarray, "h w t"], covered: Float32[ndarray, "h w t"]) -> tuple[float, float]:
    """Sum of products of masks, less their mean over time, with coverage; and the coverage's squares about its mean."""
    height, width, frames = covered.shape
    product, square = 0.0, 0.0
    for i in range(height):
        for j in range(width):
            total, squares = 0.0, 0.0
            for t in range(frames):
                value = covered[i, j, t]
                product += value * centred[i, j, t]
                total += value
                squares += value * value
            square += squares - total * total / frames
    return product, square
