"""Painted surfaces of the synthetic desk: sRGB images with a physical size."""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

Color = tuple[int, int, int]


@dataclass(frozen=True)
class Texture:
    """An image that covers `extent` metres (x, y) and repeats beyond."""

    image: np.ndarray  # [h, w, 3] uint8, sRGB
    extent: tuple[float, float]  # m


def _canvas(extent: tuple[float, float], texel: float, color: Color) -> np.ndarray:
    shape = (max(4, round(extent[1] / texel)), max(4, round(extent[0] / texel)))
    return np.full((*shape, 3), color, np.uint8)


def _mottle(rng: np.random.Generator, image: np.ndarray, amount: float, grain: int) -> np.ndarray:
    """Multiplies an image by smooth noise of `grain` texels and fine noise, so that nothing is uniform."""
    height, width = image.shape[:2]
    coarse = rng.normal(size=(max(2, height // grain + 1), max(2, width // grain + 1))).astype(np.float32)
    noise = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    noise += 0.5 * cv2.GaussianBlur(rng.normal(size=(height, width)).astype(np.float32), (0, 0), 1.0) * 2
    return np.clip(image * (1 + amount * noise)[..., None], 0, 255).astype(np.uint8)


def plain(rng: np.random.Generator, color: Color, *, amount: float = 0.05, extent: float = 0.2) -> Texture:
    """Moulded plastic, paint or plaster: one colour with faint blotches."""
    image = _canvas((extent, extent), extent / 160, color)
    return Texture(_mottle(rng, image, amount, 12), (extent, extent))


def wood(rng: np.random.Generator, color: Color, extent: tuple[float, float], plank: float) -> Texture:
    """Planks along x with grain, knots and seams."""
    texel = 0.0011
    image = _canvas(extent, texel, color).astype(np.float32)
    height, width = image.shape[:2]
    rows = max(1, round(height * texel / plank))
    for i in range(rows):
        top, bottom = i * height // rows, (i + 1) * height // rows
        board = image[top:bottom]
        drift = cv2.resize(
            rng.normal(size=(5, 9)).astype(np.float32), (width, bottom - top), interpolation=cv2.INTER_CUBIC
        )
        rings = np.sin(np.arange(bottom - top)[:, None] * 0.35 + 4.5 * drift)
        streaks = cv2.resize(rng.normal(size=(bottom - top, width // 40 + 2)).astype(np.float32), (width, bottom - top))
        board *= (1 + 0.05 * rings + 0.06 * streaks + 0.09 * rng.normal())[..., None]
        for _ in range(2):
            center = (int(rng.integers(width)), int(rng.integers(bottom - top)))
            axes = (int(rng.integers(5, 12)), int(rng.integers(3, 6)))
            cv2.ellipse(board, center, axes, 0, 0, 360, [float(c) * 0.55 for c in color], -1, cv2.LINE_AA)
            cv2.ellipse(
                board, center, (axes[0] + 4, axes[1] + 3), 0, 0, 360, [float(c) * 0.78 for c in color], 1, cv2.LINE_AA
            )
        joint = int(rng.integers(width))
        board[:2] *= 0.6
        board[:, joint : joint + 2] *= 0.65
    return Texture(cv2.GaussianBlur(np.clip(image, 0, 255), (0, 0), 0.6).astype(np.uint8), extent)


def checks(rng: np.random.Generator, colors: tuple[Color, Color], square: float, count: int = 8) -> Texture:
    """A checkerboard of soft, unequal squares."""
    texel = square / 12
    image = _canvas((square * count, square * count), texel, colors[0])
    for i in range(count):
        for j in range(count):
            shade = np.asarray(colors[(i + j) % 2]) * (1 + 0.08 * rng.normal())
            image[i * 12 : (i + 1) * 12, j * 12 : (j + 1) * 12] = np.clip(shade, 0, 255)
    return Texture(_mottle(rng, image, 0.05, 9), (square * count, square * count))


def stripes(rng: np.random.Generator, colors: tuple[Color, ...], extent: tuple[float, float]) -> Texture:
    """Horizontal bands of unequal height."""
    image = _canvas(extent, 0.001, colors[0])
    cuts = np.sort(rng.uniform(0.08, 0.92, 2 * len(colors))) * image.shape[0]
    for k, (start, stop) in enumerate(pairwise(cuts)):
        image[int(start) : int(stop)] = colors[k % len(colors)]
    return Texture(_mottle(rng, image, 0.06, 8), extent)


def label(
    rng: np.random.Generator, text: str, colors: tuple[Color, Color, Color], extent: tuple[float, float]
) -> Texture:
    """Printed packaging: ground, band with a word, emblem and lines of small print."""
    ground, band, ink = colors
    texel = max(extent) / 260
    image = _canvas(extent, texel, ground)
    height, width = image.shape[:2]
    cv2.rectangle(image, (0, int(0.14 * height)), (width, int(0.46 * height)), band, -1)
    scale = 0.82 * width / cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, 1.0, 2)[0][0]
    scale = min(scale, 0.26 * height / 22)
    (w, h), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, scale, 2)
    origin = ((width - w) // 2, int(0.30 * height) + h // 2)
    cv2.putText(image, text, origin, cv2.FONT_HERSHEY_DUPLEX, scale, ink, 2, cv2.LINE_AA)
    radius = max(3, int(0.13 * min(height, width)))
    center = (int(0.22 * width), int(0.72 * height))
    cv2.circle(image, center, radius, band, -1, cv2.LINE_AA)
    cv2.circle(image, center, radius // 2, ink, -1, cv2.LINE_AA)
    step = max(5, height // 20)
    for y in range(int(0.58 * height), int(0.9 * height), step):
        stop = int((0.55 + 0.38 * rng.random()) * width)
        cv2.line(image, (int(0.42 * width), y), (stop, y), tuple(c // 2 for c in ground), max(1, step // 3))
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), band, max(2, width // 60))
    return Texture(_mottle(rng, image, 0.03, 14), extent)


def print_sheet(rng: np.random.Generator, extent: tuple[float, float]) -> Texture:
    """A printed mat: coloured tiles, rings and a grid, detailed everywhere."""
    palette = [(222, 214, 196), (74, 126, 148), (206, 122, 74), (94, 140, 98), (226, 186, 92)]
    image = _canvas(extent, 0.0008, palette[0])
    height, width = image.shape[:2]
    cell = width // 8
    for y in range(0, height, cell):
        for x in range(0, width, cell):
            ground, ring = rng.choice(len(palette), 2, replace=False)
            cv2.rectangle(image, (x, y), (x + cell - 2, y + cell - 2), palette[ground], -1)
            center = (x + cell // 2, y + cell // 2)
            cv2.circle(image, center, int(cell * rng.uniform(0.18, 0.42)), palette[ring], -1, cv2.LINE_AA)
            cv2.circle(image, center, int(cell * 0.12), palette[ground], -1, cv2.LINE_AA)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (70, 66, 62), 5)
    return Texture(_mottle(rng, image, 0.04, 10), extent)


def keys(rng: np.random.Generator, color: Color, extent: tuple[float, float], rows: int, columns: int) -> Texture:
    """A block of light keys with dark letters on a coloured ground."""
    texel = extent[0] / 300
    image = _canvas(extent, texel, color)
    height, width = image.shape[:2]
    dx, dy = width / (columns + 0.4), height / (rows + 0.4)
    for i in range(rows):
        for j in range(columns):
            x0, y0 = int((j + 0.32) * dx), int((i + 0.32) * dy)
            x1, y1 = int((j + 1.08) * dx), int((i + 1.08) * dy)
            face = (236, 232, 222) if rng.random() > 0.18 else (232, 150, 70)
            cv2.rectangle(image, (x0, y0), (x1, y1), face, -1, cv2.LINE_AA)
            letter = chr(int(rng.integers(65, 91)))
            scale = 0.5 * (y1 - y0) / 22
            cv2.putText(
                image,
                letter,
                (x0 + int(0.28 * dx), y1 - int(0.26 * dy)),
                cv2.FONT_HERSHEY_DUPLEX,
                scale,
                (52, 52, 60),
                2,
                cv2.LINE_AA,
            )
    return Texture(_mottle(rng, image, 0.03, 12), extent)


def mip_levels(texture: Texture, count: int) -> list[np.ndarray]:
    """`count` images [h, w, 3] float32 in linear light, each half the size of the one before."""
    level = (texture.image.astype(np.float32) / 255) ** 2.2
    levels = [level]
    for _ in range(count - 1):
        height, width = level.shape[:2]
        level = cv2.resize(level, (max(2, width // 2), max(2, height // 2)), interpolation=cv2.INTER_AREA)
        levels.append(level)
    return levels
