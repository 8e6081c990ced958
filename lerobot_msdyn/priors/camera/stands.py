"""Where a camera that is meant to stand still stood during a clip: in one place, in several, or nowhere."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.sampling import REFERENCE_WIDTH, evenly
from lerobot_msdyn.priors.camera.path import CameraPath, cells, cells_won, displacement_px, distances_px, evened

DRIFT_PX = 1.5  # of 320: a picture that goes further within a stand is brought back
STEP_PX = 2.5  # of 320: a sudden move beyond which the camera stands elsewhere
MOVES_PX = 32.0  # of 320: a camera whose picture goes further within a stand moves
FARTHEST_STEP_PX = 80.0  # of 320: and one whose picture goes so far at once
MOST_STEPS = 3
LEAST_PX = 0.75  # of any picture: less cannot be told at small sizes
_BESIDE, _LEVEL = 2, 3  # frames on either side of a step in which the camera may still go; that tell where it is then
_QUIET, _QUIET_PX = 0.08, 0.3  # share of a step, and px of 320, that the camera goes per frame before and after it
_SELDOM = 0.05  # share of the frames that do not tell how far the picture goes
_FEW = 2  # frames that may be misjudged
_FASTEST = 5  # frames in which a camera that moves cannot seem to rest
_COMPARED = 12  # frames in which what the path says is held against the pictures
_SEEN, _MORE = 0.2, 1.5  # share of the cells that must be better laid over the first frame; than worse
_ALIKE = 0.9  # correlation of a cell with itself in another frame; so much, and it shows the same
_EQUAL = 3.0  # grey levels: mean difference; so little, and it does too
_RESTING = 0.3  # share of the cells; where so many are the same, the camera is where it was


@dataclass(frozen=True)
class Stand:
    """A stretch of frames during which the camera is meant to be in one place."""

    start: int
    end: int
    drift_px: float  # of 320: how far the picture goes
    path: CameraPath | None = None  # from the frame that stands for the stretch to each; None: it keeps still


@dataclass(frozen=True)
class Stands:
    """Where a camera stood during a clip."""

    stands: tuple[Stand, ...]
    steps_px: tuple[float, ...] = ()  # of 320: by how much the picture jumps from each stand to the next
    moves: bool = False  # the camera does not stand

    @property
    def drift_px(self) -> float:
        """How far the picture goes within a stand, at most; px of 320."""
        return max(stand.drift_px for stand in self.stands)

    @property
    def farthest_px(self) -> float:
        """The farthest way of the picture, within a stand or at once; px of 320."""
        return max(self.drift_px, *self.steps_px, 0.0)

    def reason(self) -> str:
        """Why new views of the clip cannot be relied on; empty if they can."""
        if not self.moves:
            return ""
        return f"its background moves by {self.farthest_px:.0f} px (of 320): it does not stand still"

    def entry(self) -> dict[str, Any]:
        """For files: the drift, and each frame before which the camera was moved, by how much; px of 320."""
        moved = [
            {"frame": stand.start, "px": round(step_px, 1)}
            for stand, step_px in zip(self.stands[1:], self.steps_px, strict=True)
        ]
        return {"drift_px": round(self.drift_px, 1), "moved": moved, "stands": not self.moves}


def is_displaced(picture: UInt8[Tensor, "h w 3"], other: UInt8[Tensor, "h w 3"]) -> bool:
    """Whether a camera stood elsewhere when it took another picture; no, where their corners do not tell."""
    displaced_px = displacement_px(picture, other)
    return displaced_px is not None and displaced_px >= _limit_px(picture.shape[1])


def stands_along(path: CameraPath, rgb: UInt8[Tensor, "t h w 3"]) -> Stands:
    """Where a camera stood, by its path (`camera_path`).

    A step is a sudden move between two stretches in which the camera is quiet; what is left within a stretch is drift.
    A camera whose picture goes far within a stretch, or very far at once, moves. What the path says counts only where
    the pictures bear it out: laid over each other by it they are more alike than as they are.
    """
    limit_px = _limit_px(path.width)
    away = np.flatnonzero(distances_px(path) > limit_px)
    if len(away) <= _FEW:
        return _one(path, limit_px)
    some = away[evenly(len(away), _COMPARED).numpy()]
    first, *others = (evened(rgb[frame].numpy()) for frame in (0, *some.tolist()))
    if not _borne_out(first, others, path.affines[some]):
        moves = _extent_px(path) > MOVES_PX and not _rests(path, rgb)
        return Stands((Stand(0, len(path), _extent_px(path)),), moves=True) if moves else _one(path, limit_px)
    cuts = _steps(path, max(STEP_PX, limit_px))
    cuts = cuts if len(cuts) <= MOST_STEPS else []
    stands = tuple(_stand(path, start, end, limit_px) for start, end in itertools.pairwise([0, *cuts, len(path)]))
    steps_px = tuple(_step_px(path.places(), cut) for cut in cuts)
    moves = max(stand.drift_px for stand in stands) > MOVES_PX or max(steps_px, default=0.0) > FARTHEST_STEP_PX
    return Stands(stands, steps_px, moves)


def _limit_px(width: int) -> float:
    """How far (px of 320) a camera may go in pictures of a width and still stand."""
    return max(DRIFT_PX, LEAST_PX * REFERENCE_WIDTH / width)


def _one(path: CameraPath, limit_px: float) -> Stands:
    """A camera that keeps still."""
    return Stands((Stand(0, len(path), min(_extent_px(path), limit_px)),))


def _stand(path: CameraPath, start: int, end: int, limit_px: float) -> Stand:
    part = path.part(slice(start, end))
    drift_px = _extent_px(part)
    if drift_px <= limit_px:
        return Stand(start, end, drift_px)
    places = part.places()
    usual = np.linalg.norm(places - np.median(places, axis=0), axis=-1).mean(1).argmin()
    return Stand(start, end, drift_px, part.against(int(usual)))


def _extent_px(path: CameraPath) -> float:
    """How far the picture goes, single frames aside."""
    low, high = np.quantile(path.places(), (_SELDOM, 1 - _SELDOM), axis=0, method="nearest")
    return float(np.median(np.linalg.norm(high - low, axis=-1)))


def _steps(path: CameraPath, least_px: float) -> list[int]:
    """Frames that are the first after a step."""
    places = path.places()
    speed = _speed(places)
    reach = _BESIDE + _LEVEL
    found: list[list[int]] = []  # frames about each step
    for cut in range(reach, len(path) - reach + 1):
        step = _step_px(places, cut)
        before, after = speed[cut - reach + 1 : cut - _BESIDE], speed[cut + _BESIDE + 1 : cut + reach]
        if step > least_px and max(np.median(before), np.median(after)) <= max(_QUIET * step, _QUIET_PX):
            if not found or found[-1][-1] < cut - 1:
                found.append([])
            found[-1].append(cut)
    return [max(about, key=lambda cut: speed[cut]) for about in found]


def _step_px(places: Float64[ndarray, "t p 2"], cut: int) -> float:
    """By how much the picture is elsewhere after a frame than before it."""
    before = np.median(places[cut - _BESIDE - _LEVEL : cut - _BESIDE], axis=0)
    after = np.median(places[cut + _BESIDE : cut + _BESIDE + _LEVEL], axis=0)
    return float(np.median(np.linalg.norm(after - before, axis=-1)))


def _borne_out(
    first: UInt8[ndarray, "h w"], others: list[UInt8[ndarray, "h w"]], affines: Float64[ndarray, "s 2 3"]
) -> bool:
    """Whether pictures are more like the first where they are laid over it."""
    won = [cells_won(first, picture, affine) for picture, affine in zip(others, affines, strict=True)]
    better, worse = np.mean(won, axis=0)
    return bool(better > max(_SEEN, _MORE * worse))


def _rests(path: CameraPath, rgb: UInt8[Tensor, "t h w 3"]) -> bool:
    """Whether much of the picture stays as it is where the path says that the camera goes fast."""
    speed = _speed(path.places())
    shares = []
    for frame in np.argsort(-speed[1:])[:_FASTEST] + 1:
        before, after = (cells(evened(rgb[i].numpy())) for i in (int(frame) - 1, int(frame)))
        same = (_correlation(before, after) > _ALIKE) | (np.abs(after - before).mean(1) < _EQUAL)
        shares.append(same.mean())
    return float(np.median(shares)) >= _RESTING


def _speed(places: Float64[ndarray, "t p 2"]) -> Float64[ndarray, " t"]:
    """How far the picture goes from the frame before to each; px of 320."""
    return np.append(0.0, np.median(np.linalg.norm(np.diff(places, axis=0), axis=-1), axis=-1))


def _correlation(one: Float64[ndarray, "c p"], other: Float64[ndarray, "c p"]) -> Float64[ndarray, " c"]:
    a, b = one - one.mean(1, keepdims=True), other - other.mean(1, keepdims=True)
    return np.asarray((a * b).sum(1) / np.sqrt((a * a).sum(1) * (b * b).sum(1)).clip(min=1e-9))
