"""Point tracks without learned weights: chained optical flow, re-registered to the patch that each track began with.

Flow between neighbouring frames (DIS, Kroeger et al. 2016) carries a point; Lucas-Kanade registration to an older
frame, the track's anchor, takes out the drift; forward-backward flow and the correlation with the anchor's patch
decide whether the point is seen.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.priors.types import PointTracks

_POINTS_PER_INSTANCE = 400  # at a time; instances too small for that get a finer grid, down to 2 px
_EDGE_MARGIN_PX = 2  # of the first points of a track from the edge of their instance ...
_SMALL_INSTANCE_PX = 1000  # ... and half of that in instances smaller than this
_PATCH = 9  # px, side of the patch that is compared with the anchor's
_LK_WINDOW = (11, 11)
_LK_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)
_MAX_POLISH_PX = 2.0  # a registration that leads farther than this from where flow put the point has slipped
_STALE_NCC = 0.8  # below this the anchor no longer looks like the point: take a newer one ...
_MIN_ANCHOR_AGE = 4  # ... unless it is younger than this, in frames
_FOUND_NCC = 0.85  # an occluded point counts as seen again, at the place where it was lost, above this
_MAX_GAP = 45  # frames for which an occluded point is looked for
_NOISE_VARIANCE = 4.0  # grey levels², of a compressed video; keeps flat patches from correlating by their noise


@dataclass(frozen=True)
class _Video:
    """Grey frames at working size and the flow between neighbours."""

    grey: list[UInt8[ndarray, "h w"]]
    forward: list[ndarray]  # [h,w,2] px, frame t -> t+1; float16 so that the flow of a clip fits in memory
    backward: list[ndarray]  # frame t+1 -> t

    def flow(self, source: int, target: int) -> tuple[ndarray, ndarray]:
        """Flow from a frame to its neighbour, and back."""
        there, back = (self.forward, self.backward) if target > source else (self.backward, self.forward)
        pair = min(source, target)
        return there[pair].astype(np.float32), back[pair].astype(np.float32)


@dataclass
class _Points:
    """The state of tracks at one frame."""

    xy: Float32[ndarray, "n 2"]  # where it is, or was last seen
    confidence: Float32[ndarray, " n"]  # 0 = not seen at this frame
    lost_for: Int[ndarray, " n"]  # frames since it was last seen
    anchor: Int[ndarray, " n"]  # frame whose patch the point is registered to
    anchor_xy: Float32[ndarray, "n 2"]

    @classmethod
    def start(cls, xy: Float32[ndarray, "n 2"], frame: int) -> "_Points":
        n = len(xy)
        return cls(xy, np.ones(n, np.float32), np.zeros(n, int), np.full(n, frame), xy.copy())

    def joined(self, other: "_Points") -> "_Points":
        return _Points(*(np.concatenate(pair) for pair in zip(vars(self).values(), vars(other).values(), strict=True)))

    def rows(self, index: ndarray) -> "_Points":
        return _Points(*(value[index] for value in vars(self).values()))


def flow_tracks(
    rgb: UInt8[Tensor, "t h w 3"],
    instances: UInt8[Tensor, "t h w"],
    *,
    grid: int = 4,
    restart_every: int = 5,
    min_ncc: float = 0.6,
    max_width: int = 480,
) -> PointTracks:
    """Follow points of the moving instances through a clip, forward and backward in time.

    Points start on a grid (`grid` px of the working image) inside the instances, 2 px from their edges, at the first
    frame and then every `restart_every` frames wherever no point is being followed. Frames wider than `max_width` are
    tracked at that width; positions are returned in pixels of `rgb`. A point is visible where forward and backward
    flow agree to 1 px + 1 %, its patch correlates with its anchor's by more than `min_ncc` and it lies on its
    instance. Tracks seen in fewer than max(3, 2 %) of the frames are dropped. Confidence is exp(-fb²/2) * correlation.
    """
    frames, height, width = instances.shape
    size = (min(width, max_width), max(1, round(height * min(1.0, max_width / width))))
    labels = np.stack([cv2.resize(m, size, interpolation=cv2.INTER_NEAREST) for m in instances.cpu().numpy()])
    xy, confidence = _follow(_open(rgb, size), labels, grid, restart_every, min_ncc)
    instance, on_instance = _vote(xy, confidence > 0, labels)
    confidence = np.where(on_instance, confidence, 0)
    kept = (instance > 0) & ((confidence > 0).sum(1) >= max(3, 0.02 * frames))
    factor = np.array([width / size[0], height / size[1]], np.float32)
    return PointTracks(
        torch.from_numpy(xy[kept] * factor),
        torch.from_numpy(confidence[kept] > 0),
        torch.from_numpy(confidence[kept]),
        torch.from_numpy(instance[kept]),
    )


def _open(rgb: UInt8[Tensor, "t h w 3"], size: tuple[int, int]) -> _Video:
    """Grey frames of `size` (width, height) and everything that tracking needs of them."""
    frames = rgb.cpu().numpy()
    grey = [cv2.resize(cv2.cvtColor(f, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA) for f in frames]
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    pairs = list(zip(grey[:-1], grey[1:], strict=True))
    return _Video(
        grey,
        [dis.calc(a, b, None).astype(np.float16) for a, b in pairs],
        [dis.calc(b, a, None).astype(np.float16) for a, b in pairs],
    )


def _follow(
    video: _Video, labels: UInt8[ndarray, "t h w"], grid: int, restart_every: int, min_ncc: float
) -> tuple[Float32[ndarray, "n t 2"], Float32[ndarray, "n t"]]:
    """Positions and confidences of all tracks: one pass forward that also starts them, one backward."""
    frames = len(labels)
    points = _Points.start(_new_points(labels[0], np.zeros((0, 2), np.float32), grid), 0)
    starts = [points.xy]  # of the tracks that begin at frame 0, restart_every, ...
    passes = [[points]]
    for target in range(1, frames):
        points = _advance(video, points, target - 1, target, min_ncc)
        if target % restart_every == 0:
            starts.append(_new_points(labels[target], points.xy[points.confidence > 0], grid))
            points = points.joined(_Points.start(starts[-1], target))
        passes[0].append(points)
    counts = np.cumsum([0] + [len(s) for s in starts])
    xy = np.zeros((counts[-1], frames, 2), np.float32)
    confidence = np.zeros((counts[-1], frames), np.float32)
    for t, points in enumerate(passes[0]):
        xy[: len(points.xy), t], confidence[: len(points.xy), t] = points.xy, points.confidence
    points = _Points.start(np.zeros((0, 2), np.float32), 0)
    for target in range(frames - 2, -1, -1):
        block, offset = divmod(target + 1, restart_every)
        if offset == 0 and block < len(starts):
            points = _Points.start(starts[block], target + 1).joined(points)
        points = _advance(video, points, target + 1, target, min_ncc)
        first = counts[-1] - len(points.xy)
        xy[first:, target], confidence[first:, target] = points.xy, points.confidence
    return xy, confidence


def _new_points(
    labels: UInt8[ndarray, "h w"], followed: Float32[ndarray, "n 2"], grid: int
) -> Float32[ndarray, "m 2"]:
    """Grid points well inside an instance that no followed point is near; on small instances the grid is finer."""
    counts = np.zeros(labels.shape, np.uint8)
    height, width = labels.shape
    column, row = followed.astype(int).T
    counts[row.clip(0, height - 1), column.clip(0, width - 1)] = 1
    points = []
    for instance in np.unique(labels[labels > 0]):
        mask = (labels == instance).astype(np.uint8)
        area = int(mask.sum())
        spacing = int(np.clip(math.sqrt(area / _POINTS_PER_INSTANCE), 2, grid))
        margin = _EDGE_MARGIN_PX if area > _SMALL_INSTANCE_PX else 1
        inside = cv2.erode(mask, _square(margin), borderType=cv2.BORDER_CONSTANT, borderValue=0)
        covered = cv2.dilate(counts, _square(spacing - 1))
        lattice = np.zeros_like(mask)
        lattice[spacing // 2 :: spacing, spacing // 2 :: spacing] = 1
        row, column = np.nonzero(inside & lattice & ~covered)
        points.append(np.stack((column, row), axis=1).astype(np.float32) + 0.5)
    return np.concatenate(points) if points else np.zeros((0, 2), np.float32)


def _square(reach: int) -> UInt8[ndarray, "s s"]:
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)


def _advance(video: _Video, points: _Points, source: int, target: int, min_ncc: float) -> _Points:
    """The points of frame `source` at the neighbouring frame `target`; lost ones stay where they were last seen."""
    after = points.rows(np.arange(len(points.xy)))
    after.confidence[:] = 0
    after.lost_for += 1
    live = np.nonzero(after.lost_for <= _MAX_GAP)[0]
    if len(live) == 0:
        return after
    now = points.rows(live)
    followed = now.confidence > 0
    forward, backward = video.flow(source, target)
    step = np.where(followed[:, None], _sample(forward, now.xy), 0)
    guess = now.xy + step
    disagreement = np.where(followed, np.linalg.norm(step + _sample(backward, guess), axis=1), 0)
    xy, ncc = _register(video, now, guess, target)

    stale = followed & (ncc < _STALE_NCC) & (abs(now.anchor - target) >= _MIN_ANCHOR_AGE)
    if stale.any():
        renewed = _Points.start(now.xy[stale], source)
        now.anchor[stale], now.anchor_xy[stale] = renewed.anchor, renewed.anchor_xy
        xy[stale], ncc[stale] = _register(video, renewed, guess[stale], target)

    agrees = disagreement < 1 + 0.01 * np.linalg.norm(step, axis=1)
    height, width = video.grey[0].shape
    inside = (xy >= 0).all(1) & (xy[:, 0] < width) & (xy[:, 1] < height)
    seen = inside & agrees & (ncc > np.where(followed, min_ncc, _FOUND_NCC))
    rows = live[seen]
    after.xy[rows], after.lost_for[rows] = xy[seen], 0
    after.anchor[rows], after.anchor_xy[rows] = now.anchor[seen], now.anchor_xy[seen]
    after.confidence[rows] = (np.exp(-(disagreement**2) / 2) * ncc)[seen]
    return after


def _register(
    video: _Video, points: _Points, guess: Float32[ndarray, "n 2"], target: int
) -> tuple[Float32[ndarray, "n 2"], Float32[ndarray, " n"]]:
    """Positions at frame `target` registered to the anchors, starting from `guess`, and their correlations."""
    polished = guess.copy()
    anchor_patches = np.empty((len(guess), _PATCH * _PATCH), np.float32)
    for anchor in np.unique(points.anchor):
        rows = points.anchor == anchor
        anchor_patches[rows] = _patches(video.grey[anchor], points.anchor_xy[rows])
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            video.grey[anchor],
            video.grey[target],
            (points.anchor_xy[rows] - 0.5).reshape(-1, 1, 2),
            (guess[rows] - 0.5).reshape(-1, 1, 2),
            winSize=_LK_WINDOW,
            maxLevel=0,
            criteria=_LK_STOP,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        polished[rows] = np.where(status > 0, found[:, 0] + 0.5, guess[rows])
    near = np.linalg.norm(polished - guess, axis=1) < _MAX_POLISH_PX
    polished = np.where(near[:, None], polished, guess)
    ncc_guess = _correlation(anchor_patches, _patches(video.grey[target], guess))
    ncc_polished = _correlation(anchor_patches, _patches(video.grey[target], polished))
    better = ncc_polished >= ncc_guess
    return np.where(better[:, None], polished, guess), np.where(better, ncc_polished, ncc_guess)


def _patches(grey: UInt8[ndarray, "h w"], xy: Float32[ndarray, "n 2"]) -> Float32[ndarray, "n p"]:
    """Square patches about sub-pixel positions, one row each."""
    offset = np.arange(_PATCH, dtype=np.float32) - _PATCH // 2
    dy, dx = np.meshgrid(offset, offset, indexing="ij")
    centre = xy - 0.5
    return cv2.remap(
        grey.astype(np.float32),
        centre[:, :1] + dx.reshape(1, -1),
        centre[:, 1:] + dy.reshape(1, -1),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )


def _correlation(a: Float32[ndarray, "n p"], b: Float32[ndarray, "n p"]) -> Float32[ndarray, " n"]:
    """Normalised cross-correlation of patches, row by row; two patches flatter than the noise count as alike."""
    a, b = a - a.mean(1, keepdims=True), b - b.mean(1, keepdims=True)
    energy = np.sqrt(((a * a).mean(1) + _NOISE_VARIANCE) * ((b * b).mean(1) + _NOISE_VARIANCE))
    return ((a * b).mean(1) + _NOISE_VARIANCE) / energy


def _sample(image: ndarray, xy: Float32[ndarray, "n 2"]) -> ndarray:
    """Bilinear values of an image [h,w,c] at pixel positions."""
    x, y = (xy - 0.5).T
    return cv2.remap(
        image, x[:, None].copy(), y[:, None].copy(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).reshape(len(xy), -1)


def _vote(
    xy: Float32[ndarray, "n t 2"], visible: Bool[ndarray, "n t"], labels: UInt8[ndarray, "t h w"]
) -> tuple[Int[ndarray, " n"], Bool[ndarray, "n t"]]:
    """Instance of each track (0: it lies on the background for most of its life), and where it is on that instance."""
    frames, height, width = labels.shape
    column = xy[..., 0].astype(int).clip(0, width - 1)
    row = xy[..., 1].astype(int).clip(0, height - 1)
    under = np.where(visible, labels[np.arange(frames), row, column], 0)
    votes = np.stack([((under == i) & visible).sum(1) for i in range(int(labels.max()) + 1)], axis=1)
    instance = votes.argmax(1)
    return instance, visible & (under == instance[:, None])
