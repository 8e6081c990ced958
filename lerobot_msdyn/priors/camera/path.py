"""Where the picture of a camera goes during a clip: every frame against the first, whatever moves before the camera."""

import itertools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.sampling import REFERENCE_WIDTH, scaled_px
from lerobot_msdyn.render.cpu.threads import in_threads

Affine = Float64[ndarray, "2 3"]

_ROWS, _COLUMNS = 6, 8  # cells of a picture, which count alike whatever their number of corners
_CORNERS = 6  # of a cell, at most
_APART_PX = 5  # between corners
_WINDOW, _LEVELS = (15, 15), 4
_RETURN_PX = 0.5  # difference of a corner to itself, followed there and back
_AGREE_PX = 1.0  # of 320, at least 0.75 px: distance of a corner from where a motion takes it
_ROUNDS = 3  # of least squares over the corners that agree
_FEATURES, _DISTINCT, _MIN_PAIRS, _ROUGH_PX = 600, 0.8, 12, 3.0  # SIFT: at most; ratio to the second best; agreement
_TURNING_CELLS = 8  # that must agree for a motion to turn or scale the picture
_DARK = 8.0  # grey levels, added to both sides of a ratio
_FEW = 0.35  # share of the cells; where fewer are for a motion, features are looked for that look alike
_FOR_REST = 1.5  # a still background wins against a motion that so many times as many cells show: an arm may be large
_NEXT, _NEAR, _REST = 0.15, 0.2, 0.3  # share of the cells for: a next frame, a guess, rest
_MORE = 2.5  # times as many cells must be better laid over by a motion as worse: an arm covers fewer
_CLEARLY, _SEEN_GREY = 0.1, 1.0  # difference of cells that counts, relative and in grey levels of the evened pictures
_CAPPED = 24  # grey levels; larger differences are of other things
_GRID = 5  # points to a side of the picture, over which its motion is told
_SMALLEST_PX = 0.75  # of any picture; less cannot be told at small sizes


@dataclass(frozen=True)
class CameraPath:
    """Similarities that carry the pixels of a clip's first frame to those of each."""

    affines: Float64[ndarray, "t 2 3"]  # px of a picture of this size
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.affines)

    def places(self) -> Float64[ndarray, "t p 2"]:
        """Where some points of the picture, evenly spread, are at each frame; px of 320."""
        x, y = ((np.arange(_GRID) + 0.5) / _GRID * size for size in (self.width, self.height))
        points = np.stack((*np.meshgrid(x, y), np.ones((_GRID, _GRID))), axis=-1).reshape(-1, 3)
        return points @ self.affines.transpose(0, 2, 1) * (REFERENCE_WIDTH / self.width)

    def part(self, frames: slice | Int[Tensor, " s"]) -> "CameraPath":
        """That of some of the frames, against the same first one."""
        return CameraPath(self.affines[frames], self.width, self.height)

    def against(self, frame: int) -> "CameraPath":
        """The same motion, from another frame to each."""
        back = cv2.invertAffineTransform(self.affines[frame])
        return CameraPath(np.stack([_after(back, affine) for affine in self.affines]), self.width, self.height)

    def resized(self, width: int, height: int) -> "CameraPath":
        """The same for pictures of another size."""
        sizes = np.array([width / self.width, height / self.height])
        affines = self.affines * sizes[:, None] / np.append(sizes, 1.0)
        affines[..., :2] = self.affines[..., :2]
        return CameraPath(affines, width, height)


def camera_path(rgb: UInt8[Tensor, "t h w 3"]) -> CameraPath:
    """The path of a camera, from the corners of its background.

    A frame is first laid over the one before, then over the first, near to where the path has led. What moves before
    the camera does not matter while it covers less than about half of the picture. Frames that cannot be laid over
    others are taken to be where the one before was. Pictures wider than 320 px are looked at in that width.
    """
    corners = in_threads(lambda frame: _Corners(evened(frame)), rgb.numpy())
    reference = next(corners)
    pairs = itertools.pairwise(itertools.chain([reference], corners))
    affine, before = _still(), reference
    affines = [affine]
    for last, here, step in in_threads(lambda pair: (*pair, pair[0].motion_to(pair[1])), pairs):
        if before is not last:  # onto which nothing could be laid
            step = before.motion_to(here)
        if step is not None:
            affine, before = _after(affine, step), here
        found = reference.motion_near(here, affine)
        affine = affine if found is None else found
        affines.append(affine)
    height, width = reference.picture.shape
    return CameraPath(np.stack(affines), width, height)


def displacement_px(picture: UInt8[Tensor, "h w 3"], other: UInt8[Tensor, "h w 3"]) -> float | None:
    """By how much the background of one picture is displaced in another (px of 320); None: it cannot be told."""
    first, second = (_Corners(evened(image.numpy())) for image in (picture, other))
    found = first.motion_anywhere(second)
    if found is None:
        return None
    height, width = first.picture.shape
    return float(distances_px(CameraPath(np.stack((_still(), found)), width, height))[1])


def distances_px(path: CameraPath) -> Float64[ndarray, " t"]:
    """By how much the picture is displaced against the first frame: the median over its points (px of 320)."""
    places = path.places()
    still = CameraPath(_still()[None], path.width, path.height).places()
    return np.asarray(np.median(np.linalg.norm(places - still, axis=-1), axis=-1))


def cells_won(picture: UInt8[ndarray, "h w"], other: UInt8[ndarray, "h w"], affine: Affine) -> tuple[float, float]:
    """Shares of a picture's cells that are clearly more, and less, like another laid over it than like it as it is."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = picture.shape[::-1]
    seen = cells(cv2.warpAffine(np.ones_like(picture), affine, size, flags=flags)) > 0
    laid, there = (
        cells(cv2.absdiff(picture, image)).clip(max=_CAPPED)
        for image in (cv2.warpAffine(other, affine, size, flags=flags), other)
    )
    count = seen.sum(1)
    with_motion, without = ((seen * each).sum(1) for each in (laid, there))
    better = (count > 0) & (with_motion < (1 - _CLEARLY) * without) & (without - with_motion > _SEEN_GREY * count)
    worse = (count > 0) & (without < (1 - _CLEARLY) * with_motion)
    return float(better.mean()), float(worse.mean())


def cells(picture: UInt8[ndarray, "h w"]) -> Float64[ndarray, "c p"]:
    """The pixels of each cell of a picture."""
    height, width = (size // count for size, count in zip(picture.shape, (_ROWS, _COLUMNS), strict=True))
    whole = picture[: height * _ROWS, : width * _COLUMNS].reshape(_ROWS, height, _COLUMNS, width)
    return whole.transpose(0, 2, 1, 3).reshape(_ROWS * _COLUMNS, -1).astype(np.float64)


def _still() -> Affine:
    return np.eye(2, 3)


def _after(first: Affine, second: Affine) -> Affine:
    """One motion after another."""
    return second[:, :2] @ first + np.concatenate((np.zeros((2, 2)), second[:, 2:]), axis=1)


def evened(frame: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "i j"]:
    """Grey, at most 320 wide, relative to the brightness around: exposure and shadows do not matter."""
    grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    if width > REFERENCE_WIDTH:
        grey = cv2.resize(
            grey, (REFERENCE_WIDTH, round(height * REFERENCE_WIDTH / width)), interpolation=cv2.INTER_AREA
        )
    bright = grey.astype(np.float32) + _DARK
    around = cv2.GaussianBlur(bright, (0, 0), max(3.0, scaled_px(10, grey.shape[1])))
    return (100 * bright / around).clip(0, 255).round().astype(np.uint8)


class _Corners:
    """A picture, its corners and the cells in which they lie."""

    def __init__(self, picture: UInt8[ndarray, "h w"]) -> None:
        self.picture = picture
        self.xy, self.cell = _corners(picture)
        count = np.bincount(self.cell, minlength=_ROWS * _COLUMNS)
        cells = max(int((count > 0).sum()), 1)
        self.share = 1 / (count[self.cell] * cells)  # of each corner: all cells together are 1
        self.agree_px = max(_SMALLEST_PX, scaled_px(_AGREE_PX, picture.shape[1]))

    def motion_to(self, other: "_Corners") -> Affine | None:
        """To the next frame, in which most of the background is seen again."""
        found, good = self._followed(other, _still())
        rest, for_rest = self._agreed(found, good, _still())
        motion, for_motion = self._agreed(found, good, self._any(found, good))
        if for_motion >= max(_NEXT, _FOR_REST * for_rest) and self._is_like(other, motion):
            return motion
        if max(for_rest, for_motion) < _FEW:
            motion, for_motion = self._matched(other)
            if for_motion >= max(_NEXT, _FOR_REST * for_rest) and self._is_like(other, motion):
                return motion
        return rest if for_rest >= _NEXT else None

    def motion_near(self, other: "_Corners", guess: Affine) -> Affine | None:
        """To any frame: near the guess, or at rest."""
        found, good = self._followed(other, guess)
        near, for_near = self._agreed(found, good, guess)
        as_guessed = np.abs(_moved(guess, self.xy) - self.xy).max(initial=0.0) < self.agree_px
        rested, rest_good = (found, good) if as_guessed else self._followed(other, _still())
        rest, for_rest = self._agreed(rested, rest_good, _still())
        if for_rest >= _REST and for_rest > for_near:
            return rest
        return near if for_near >= _NEAR else None

    def motion_anywhere(self, other: "_Corners") -> Affine | None:
        """To a picture of another time that shows most of the same background, perhaps far from where it was."""
        near = self.motion_near(other, _still())
        if near is not None:
            return near
        found, good = self._followed(other, _still())
        motion, share = max(
            self._agreed(found, good, self._any(found, good)), self._matched(other), key=lambda each: each[1]
        )
        better, worse = cells_won(self.picture, other.picture, motion)
        return motion if share >= _NEAR and better > _MORE * worse else None

    def _is_like(self, other: "_Corners", motion: Affine) -> bool:
        """Whether most of the picture is more like another where that is laid over it."""
        better, worse = cells_won(self.picture, other.picture, motion)
        return better > _MORE * worse + (1 - better - worse)

    def _matched(self, other: "_Corners") -> tuple[Affine, float]:
        """A motion near to that of features that look alike (SIFT), and its share of the cells."""
        sift = cv2.SIFT.create(_FEATURES)
        enlarged = REFERENCE_WIDTH / self.picture.shape[1]
        (points, looks), (others, other_looks) = (
            sift.detectAndCompute(cv2.resize(each.picture, None, fx=enlarged, fy=enlarged), None)
            for each in (self, other)
        )
        if looks is None or other_looks is None or len(others) < 2:
            return _still(), 0.0
        pairs = [
            first
            for first, second in cv2.BFMatcher().knnMatch(looks, other_looks, k=2)
            if first.distance < _DISTINCT * second.distance
        ]
        if len(pairs) < _MIN_PAIRS:
            return _still(), 0.0
        here = np.array([points[pair.queryIdx].pt for pair in pairs], np.float32) / enlarged
        there = np.array([others[pair.trainIdx].pt for pair in pairs], np.float32) / enlarged
        guess, _ = cv2.estimateAffinePartial2D(here, there, method=cv2.RANSAC, ransacReprojThreshold=_ROUGH_PX)
        if guess is None:
            return _still(), 0.0
        return self._agreed(*self._followed(other, guess), guess)

    def _followed(self, other: "_Corners", guess: Affine) -> tuple[Float64[ndarray, "n 2"], Bool[ndarray, " n"]]:
        """The corners in another picture, looked for near a guess, and whether they were found."""
        if len(self.xy) == 0:
            return np.zeros((0, 2)), np.zeros(0, bool)
        start = self.xy[:, None]
        near = _moved(guess, self.xy).astype(np.float32)[:, None]
        how: dict[str, Any] = {"winSize": _WINDOW, "maxLevel": _LEVELS, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
        there, ahead, _ = cv2.calcOpticalFlowPyrLK(self.picture, other.picture, start, near.copy(), **how)
        away = (start + (there - near)).astype(np.float32)
        back, returned, _ = cv2.calcOpticalFlowPyrLK(other.picture, self.picture, there, away, **how)
        good = (ahead[:, 0] > 0) & (returned[:, 0] > 0) & (np.linalg.norm(back - start, axis=-1)[:, 0] < _RETURN_PX)
        return there[:, 0].astype(np.float64), good

    def _any(self, found: Float64[ndarray, "n 2"], good: Bool[ndarray, " n"]) -> Affine | None:
        if good.sum() < 6:
            return None
        affine, _ = cv2.estimateAffinePartial2D(
            self.xy[good], found[good].astype(np.float32), method=cv2.RANSAC, ransacReprojThreshold=self.agree_px
        )
        return None if affine is None else np.asarray(affine, np.float64)

    def _agreed(
        self, found: Float64[ndarray, "n 2"], good: Bool[ndarray, " n"], affine: Affine | None
    ) -> tuple[Affine, float]:
        """A motion made to fit the corners that agree with it, and the share of the cells in which they lie."""
        if affine is None:
            return _still(), 0.0
        for _ in range(_ROUNDS):
            agree = good & (np.linalg.norm(found - _moved(affine, self.xy), axis=-1) < self.agree_px)
            if agree.sum() < 4:
                return affine, 0.0
            turns = len(np.unique(self.cell[agree])) >= _TURNING_CELLS
            affine = _least_squares(self.xy[agree], found[agree], self.share[agree], turns=turns)
        agree = good & (np.linalg.norm(found - _moved(affine, self.xy), axis=-1) < self.agree_px)
        return affine, float(self.share[agree].sum())


def _moved(affine: Affine, xy: Float32[ndarray, "n 2"]) -> Float64[ndarray, "n 2"]:
    return xy @ affine[:, :2].T + affine[:, 2]


def _least_squares(
    xy: Float32[ndarray, "n 2"], found: Float64[ndarray, "n 2"], weight: Float64[ndarray, " n"], *, turns: bool
) -> Affine:
    """The weighted similarity, or shift, from some points to others."""
    weight = weight[:, None] / weight.sum()
    middle, other = (weight * xy).sum(0), (weight * found).sum(0)
    a, b = 1.0, 0.0
    if turns:
        p, q = xy - middle, found - other
        size = float((weight * p * p).sum())
        a = float((weight * p * q).sum()) / size
        b = float((weight[:, 0] * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])).sum()) / size
    turn = np.array([[a, -b], [b, a]])
    return np.concatenate((turn, (other - turn @ middle)[:, None]), axis=1)


def _corners(picture: UInt8[ndarray, "h w"]) -> tuple[Float32[ndarray, "n 2"], Int[ndarray, " n"]]:
    """The best corners of each cell, and their cells; none where a picture has no texture."""
    height, width = picture.shape
    strength = cv2.cornerMinEigenVal(picture, 5)
    strength[[0, 1, -2, -1]] = 0
    strength[:, [0, 1, -2, -1]] = 0
    peak = (strength == cv2.dilate(strength, np.ones((_APART_PX, _APART_PX)))) & (strength > _weakest(strength))
    y, x = np.nonzero(peak)
    cell = (y * _ROWS // height) * _COLUMNS + x * _COLUMNS // width
    order = np.lexsort((-strength[y, x], cell))
    starts = np.searchsorted(cell[order], np.arange(_ROWS * _COLUMNS))
    rank = np.arange(len(order)) - starts[cell[order]]
    chosen = order[rank < _CORNERS]
    return np.stack((x[chosen], y[chosen]), axis=1).astype(np.float32), cell[chosen]


def _weakest(strength: Float32[ndarray, "h w"]) -> float:
    """Below which a corner is noise."""
    return 0.01 * float(np.quantile(strength, 0.99))
