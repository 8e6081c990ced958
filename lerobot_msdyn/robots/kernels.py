"""Compiled loops: depth of triangles, coverage of points."""

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32
from numpy import ndarray

from lerobot_msdyn.core.compiled import compiled


@compiled
def project_vertices(
    vertices: Float32[ndarray, "v 3"],
    link: Int32[ndarray, " v"],
    camera_from_link: Float64[ndarray, "l 4 4"],
    focal: float,
    cx: float,
    cy: float,
    out: Float64[ndarray, "v 3"],
) -> None:
    """Where vertices are in the picture (px; pixel centres are whole numbers), and 1/z (1/m); 0 if nearer than 1 cm."""
    for v in range(vertices.shape[0]):
        pose, x, y, z = camera_from_link[link[v]], vertices[v, 0], vertices[v, 1], vertices[v, 2]
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if depth < 0.01:
            out[v] = 0.0
            continue
        out[v, 0] = focal * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / depth + cx - 0.5
        out[v, 1] = focal * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / depth + cy - 0.5
        out[v, 2] = 1.0 / depth


@compiled
def draw_triangles(
    points: Float64[ndarray, "v 3"],
    faces: Int32[ndarray, "f 3"],
    depth: Float32[ndarray, "h w"],
    index: Int32[ndarray, "h w"],
) -> None:
    """Z-buffer of triangles of `project_vertices`: where they are nearer than `depth` (m), it and `index` (the face)
    are replaced. Triangles that reach behind 1 cm are left out.
    """
    height, width = depth.shape
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        xa, xb, xc = points[a, 0], points[b, 0], points[c, 0]
        x0, x1 = max(0, int(np.ceil(min(xa, xb, xc)))), min(width - 1, int(np.floor(max(xa, xb, xc))))
        if x0 > x1:
            continue
        ya, yb, yc = points[a, 1], points[b, 1], points[c, 1]
        y0, y1 = max(0, int(np.ceil(min(ya, yb, yc)))), min(height - 1, int(np.floor(max(ya, yb, yc))))
        if y0 > y1:
            continue
        na, nb, nc = points[a, 2], points[b, 2], points[c, 2]
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        if area == 0.0 or na == 0.0 or nb == 0.0 or nc == 0.0:
            continue
        inverse = 1.0 / area
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                wa = ((xb - x) * (yc - y) - (xc - x) * (yb - y)) * inverse
                wb = ((xc - x) * (ya - y) - (xa - x) * (yc - y)) * inverse
                wc = 1.0 - wa - wb
                if wa < 0 or wb < 0 or wc < 0:
                    continue
                z = 1.0 / (wa * na + wb * nb + wc * nc)
                if z < depth[y, x]:
                    depth[y, x] = z
                    index[y, x] = face


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
