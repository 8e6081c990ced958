"""Point tracks without learned weights: chained optical flow, re-registered to the patch that each track began with.

Flow between neighbouring frames (DIS, Kroeger et al. 2016) carries a point; Lucas-Kanade registration to the patch
about it in an older frame, its anchor, takes out the drift; forward-backward flow and the correlation with the
anchor's patch decide whether the point is seen. Only the part of a patch that lies on the point's own instance counts:
what is behind an edge moves differently.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.images import box_about
from lerobot_msdyn.core.observations import PointTracks
from lerobot_msdyn.core.sampling import scaled_window
from lerobot_msdyn.priors.tracks.patches import Patches, cut, register, sample
from lerobot_msdyn.render.cpu.threads import in_threads

PairFlow = Callable[[ndarray, ndarray], ndarray]

_FEW_POINTS, _MANY_POINTS = 400, 1500  # per instance and frame; for fewer the grid is finer, for more coarser
_EDGE_MARGIN_PX = 2  # of 320, of the first points of a track from the edge of their instance ...
_SMALL_INSTANCE = 0.013  # of the picture: ... and half of that in instances smaller than this
_BACKGROUND_GREY = 128  # of what does not move, while flow is computed
_LEAST_FLOW_PX = 64  # side of the part of a picture in which flow is computed
_PAIRS = 16  # of frames, whose flow a thread computes at a time
_SMOOTH_PX = 4  # of 320, to either side, over which an instance's flow is averaged for the second guess
_STALE_NCC = 0.8  # below this the anchor no longer looks like the point: take a newer one ...
_MIN_ANCHOR_AGE = 4  # ... unless it is younger than this, in frames
_FOUND_NCC = 0.85  # an occluded point counts as seen again, at the place where it was lost, above this
_MAX_GAP = 45  # frames for which an occluded point is looked for


@dataclass(frozen=True)
class _Video:
    """Grey frames at working size, their instances, and the flow between neighbours."""

    grey: list[Float32[ndarray, "h w"]]
    labels: UInt8[ndarray, "t h w"]
    forward: list[ndarray]  # [h,w,2] px, frame t -> t+1; float16 so that the flow of a clip fits in memory
    backward: list[ndarray]  # frame t+1 -> t

    def flow(self, source: int, target: int) -> tuple[ndarray, ndarray]:
        """Flow from a frame to its neighbour, and back."""
        there, back = (self.forward, self.backward) if target > source else (self.backward, self.forward)
        pair = min(source, target)
        return there[pair].astype(np.float32), back[pair].astype(np.float32)

    def patches(self, frame: int, xy: Float32[ndarray, "n 2"]) -> Patches:
        """Patches about some points, with the weight of what lies on each point's own instance."""
        return cut(self.grey[frame], self.labels[frame], xy)


@dataclass
class _Points:
    """The state of tracks at one frame."""

    xy: Float32[ndarray, "n 2"]  # where it is, or was last seen
    confidence: Float32[ndarray, " n"]  # 0 = not seen at this frame
    lost_for: Int[ndarray, " n"]  # frames since it was last seen
    anchored: Int[ndarray, " n"]  # frame of the anchor
    anchor: Patches

    def joined(self, other: "_Points") -> "_Points":
        """Both sets, this one first."""
        return _Points(
            np.concatenate((self.xy, other.xy)),
            np.concatenate((self.confidence, other.confidence)),
            np.concatenate((self.lost_for, other.lost_for)),
            np.concatenate((self.anchored, other.anchored)),
            self.anchor.joined(other.anchor),
        )

    def rows(self, index: ndarray) -> "_Points":
        """Some of the points, copied."""
        return _Points(
            self.xy[index],
            self.confidence[index],
            self.lost_for[index],
            self.anchored[index],
            self.anchor.rows(index),
        )


def flow_tracks(
    rgb: UInt8[Tensor, "t h w 3"],
    instances: UInt8[Tensor, "t h w"],
    *,
    grid: int = 4,
    restart_every: int = 5,
    min_ncc: float = 0.7,
    max_width: int = 480,
    flow: PairFlow | None = None,
) -> PointTracks:
    """Follow points of the moving instances through a clip, forward and backward in time.

    Points start on a grid (`grid` px of the working image; finer on small instances, coarser on very large ones),
    2 px from the edges of their instance, at the first frame and then every `restart_every` frames wherever no point
    is being followed. Frames wider than `max_width` are tracked at that width; positions are returned in pixels of
    `rgb`. A point is visible where forward and backward flow agree to 1 px + 1 %, its patch correlates with its
    anchor's by more than `min_ncc` and it lies on its instance. Tracks seen in fewer than max(3, 2 %) of the frames are
    dropped. Confidence is exp(-fb²/2) times the correlation. `flow` replaces DIS: two colour pictures at the working
    size -> the flow (px) from the first to the second.
    """
    frames, height, width = instances.shape
    size = (min(width, max_width), max(1, round(height * min(1.0, max_width / width))))
    labels = np.stack([cv2.resize(m, size, interpolation=cv2.INTER_NEAREST) for m in instances.cpu().numpy()])
    xy, confidence = _follow(_open(rgb, labels, flow), grid, restart_every, min_ncc)
    instance, on_instance = _vote(xy, confidence > 0, labels)
    confidence = np.where(on_instance, confidence, np.float32(0))
    kept = (instance > 0) & ((confidence > 0).sum(1) >= max(3, 0.02 * frames))
    factor = np.array([width / size[0], height / size[1]], np.float32)
    return PointTracks(
        torch.from_numpy(xy[kept] * factor),
        torch.from_numpy(confidence[kept] > 0),
        torch.from_numpy(confidence[kept]),
        torch.from_numpy(instance[kept]),
    )


def _open(rgb: UInt8[Tensor, "t H W 3"], labels: UInt8[ndarray, "t h w"], flow: PairFlow | None) -> _Video:
    """Grey frames of the labels' size, and their flow."""
    size = (labels.shape[2], labels.shape[1])
    frames = rgb.cpu().numpy()
    grey = [cv2.resize(cv2.cvtColor(f, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA) for f in frames]
    if flow is None:
        forward, backward = _dis_flows(grey, labels)
    else:
        colours = [cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames]
        forward = [flow(a, b).astype(np.float16) for a, b in itertools.pairwise(colours)]
        backward = [flow(b, a).astype(np.float16) for a, b in itertools.pairwise(colours)]
    return _Video([image.astype(np.float32) for image in grey], labels, forward, backward)


def _dis_flows(
    grey: list[UInt8[ndarray, "h w"]], labels: UInt8[ndarray, "t h w"]
) -> tuple[list[ndarray], list[ndarray]]:
    """Flow of what moves between neighbouring frames, there and back; 0 far from what moves."""
    alone = [_without_background(image, mask) for image, mask in zip(grey, labels > 0, strict=True)]
    flows = np.zeros((2, len(grey) - 1, *grey[0].shape, 2), np.float16)

    def of_pairs(pairs: range) -> None:
        dis = _dis()  # not for two threads at once
        for t in pairs:
            box = box_about((labels[t] > 0) | (labels[t + 1] > 0), _LEAST_FLOW_PX)
            a, b = alone[t][box].copy(), alone[t + 1][box].copy()
            if a.size:
                flows[0, t][box], flows[1, t][box] = dis.calc(a, b, None), dis.calc(b, a, None)

    pairs = range(len(grey) - 1)
    for _ in in_threads(of_pairs, [pairs[i : i + _PAIRS] for i in range(0, len(pairs), _PAIRS)]):
        pass
    return list(flows[0]), list(flows[1])


def _dis() -> cv2.DISOpticalFlow:
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(0)  # on small, plain parts of a robot a fifth to a third less error than the preset's half size
    dis.setPatchStride(4)  # this and the next two take 40 % off the time and change 0.04 px, which tracks do not show
    dis.setGradientDescentIterations(16)
    dis.setVariationalRefinementIterations(3)
    return dis


def _without_background(grey: UInt8[ndarray, "h w"], mask: Bool[ndarray, "h w"]) -> UInt8[ndarray, "h w"]:
    """The picture with everything still painted over in one grey.

    The flow of thin things that move fast before a textured background would else be that of the background.
    """
    return np.where(mask, grey, np.uint8(_BACKGROUND_GREY))


def _follow(
    video: _Video, grid: int, restart_every: int, min_ncc: float
) -> tuple[Float32[ndarray, "n t 2"], Float32[ndarray, "n t"]]:
    """Positions and confidences of all tracks: one pass forward, which also starts them, and one backward."""
    frames = len(video.labels)
    nothing = np.zeros((0, 2), np.float32)
    points = _start(video, 0, _new_points(video.labels[0], nothing, grid))
    starts, history = (
        [points],
        [(points.xy, points.confidence)],
    )  # the tracks that begin at frames 0, restart_every, ...
    for target in range(1, frames):
        points = _advance(video, points, target - 1, target, min_ncc)
        if target % restart_every == 0:
            followed = points.xy[points.confidence > 0]
            starts.append(_start(video, target, _new_points(video.labels[target], followed, grid)))
            points = points.joined(starts[-1])
        history.append((points.xy, points.confidence))  # without the anchors, most of the memory
    count = len(points.xy)
    xy, confidence = np.zeros((count, frames, 2), np.float32), np.zeros((count, frames), np.float32)
    for t, (places, sure) in enumerate(history):
        xy[: len(places), t], confidence[: len(places), t] = places, sure
    points = _start(video, 0, nothing)
    for target in range(frames - 2, -1, -1):
        block, offset = divmod(target + 1, restart_every)
        if offset == 0:
            points = starts[block].joined(points)
        points = _advance(video, points, target + 1, target, min_ncc)
        first = count - len(points.xy)
        xy[first:, target], confidence[first:, target] = points.xy, points.confidence
    return xy, confidence


def _start(video: _Video, frame: int, xy: Float32[ndarray, "n 2"]) -> _Points:
    """Tracks that begin at a frame."""
    n = len(xy)
    return _Points(xy, np.ones(n, np.float32), np.zeros(n, int), np.full(n, frame), video.patches(frame, xy))


def _new_points(labels: UInt8[ndarray, "h w"], followed: Float32[ndarray, "n 2"], grid: int) -> Float32[ndarray, "m 2"]:
    """Grid points well inside an instance that no followed point is near; on small instances the grid is finer."""
    occupied = np.zeros(labels.shape, np.uint8)
    height, width = labels.shape
    column, row = followed.astype(int).T
    occupied[row.clip(0, height - 1), column.clip(0, width - 1)] = 1
    points: list[ndarray] = [np.zeros((0, 2), np.float32)]
    for instance in np.unique(labels[labels > 0]):
        mask = (labels == instance).astype(np.uint8)
        area = int(mask.sum())
        spacing = int(np.clip(math.sqrt(area / _FEW_POINTS), 2, max(grid, math.sqrt(area / _MANY_POINTS))))
        margin = scaled_window(_EDGE_MARGIN_PX if area > _SMALL_INSTANCE * mask.size else 1, width)
        inside = cv2.erode(mask, margin, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        covered = cv2.dilate(occupied, _square(spacing - 1))
        lattice = np.zeros_like(mask)
        lattice[spacing // 2 :: spacing, spacing // 2 :: spacing] = 1
        row, column = np.nonzero(inside & lattice & (1 - covered))
        points.append(np.stack((column, row), axis=1).astype(np.float32) + 0.5)
    return np.concatenate(points)


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
    guess, disagreement = _guess(video, now, followed, source, target)
    xy, ncc = register(now.anchor, video.grey[target], guess)

    stale = np.nonzero(followed & (ncc < _STALE_NCC) & (abs(now.anchored - target) >= _MIN_ANCHOR_AGE))[0]
    if len(stale):
        renewed = video.patches(source, now.xy[stale])
        now.anchored[stale] = source
        now.anchor.replace(stale, renewed)
        xy[stale], ncc[stale] = register(renewed, video.grey[target], guess[stale])

    step = np.linalg.norm(guess - now.xy, axis=1)
    height, width = video.grey[0].shape
    inside = (xy >= 0).all(1) & (xy[:, 0] < width) & (xy[:, 1] < height)
    seen = inside & (disagreement < 1 + 0.01 * step) & (ncc > np.where(followed, min_ncc, _FOUND_NCC))
    rows = live[seen]
    after.xy[rows], after.lost_for[rows], after.anchored[rows] = xy[seen], 0, now.anchored[seen]
    after.anchor.replace(rows, now.anchor.rows(seen))
    after.confidence[rows] = (np.exp(-(disagreement**2) / 2) * ncc)[seen]
    return after


def _guess(
    video: _Video, points: _Points, followed: Bool[ndarray, " n"], source: int, target: int
) -> tuple[Float32[ndarray, "n 2"], Float32[ndarray, " n"]]:
    """Where flow takes the points, and by how much (px) forward and backward flow disagree; lost points stay.

    Near edges the flow may be that of what lies behind: the mean flow of the instance thereabouts is tried as well.
    """
    forward, backward = video.flow(source, target)
    best = (points.xy.copy(), np.zeros(len(points.xy), np.float32), np.full(len(points.xy), -np.inf, np.float32))
    for mask in (None, video.labels[source] > 0):
        there = sample(forward if mask is None else _masked_mean(forward, mask), points.xy)
        guess = points.xy + there
        back = sample(backward if mask is None else _masked_mean(backward, video.labels[target] > 0), guess)
        disagreement = np.linalg.norm(there + back, axis=1)
        ncc = points.anchor.correlation(video.grey[target], guess)
        better = followed & (ncc > best[2])
        for values, candidate in zip(best, (guess, disagreement, ncc), strict=True):
            values[better] = candidate[better]
    return best[:2]


def _masked_mean(flow: Float32[ndarray, "h w 2"], mask: Bool[ndarray, "h w"]) -> Float32[ndarray, "h w 2"]:
    """Mean flow of the masked pixels in a window about every pixel; 0 far from all."""
    window = scaled_window(_SMOOTH_PX, mask.shape[1]).shape
    mean, box = np.zeros_like(flow), box_about(mask)
    if mask[box].size:
        weight = cv2.blur(mask[box].astype(np.float32), window)
        mean[box] = cv2.blur(flow[box] * mask[box][..., None], window) / np.maximum(weight, 1e-6)[..., None]
    return mean


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
