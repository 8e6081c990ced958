"""What moves before a camera that moves itself: what is left when the neighbouring frames are laid over a frame."""

import itertools

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.images import masked_median
from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.priors.fused_frames import Source, fused, tolerance_of, usual_difference
from lerobot_msdyn.priors.masks.change import Reference, along_edges

_OFFSETS = (-12, -8, -4, 4, 8, 12)  # frames that are laid over a frame; together they show its background
_MIN_SEEN = 3  # of them, without which a pixel is not judged
_COMPARED = 12  # frames by which the tolerance of depth is found
_CORNERS = 600
_MIN_CORNERS = 12  # that must agree on a homography
_AGREE_PX = 1.5
_ELSEWHERE = 8  # frames of all of the clip that show it as well, where poses and depth are known
_NEARER, _BY_DEPTH = 2.0, 2.0  # times the tolerance of depth, before the background: so many log-odds for moving
_NOISE_FLOOR = 2.0  # CIE Lab units: warped pictures are a little blurred


def residual_odds(frames: UInt8[ndarray, "t h w 3"]) -> Float32[ndarray, "t h w"]:
    """Log-odds that a pixel differs from the background that its neighbouring frames show (0 = not known).

    Frames are laid over each other by a homography of the corners that agree (RANSAC): exact for a camera that turns,
    and for what is flat or far; near things before a far ground keep a rim of parallax.
    """
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    links = [_homography(a, b) for a, b in itertools.pairwise(grey)]
    out = np.zeros(frames.shape[:3], np.float32)
    for t in range(len(frames)):
        others = [t + offset for offset in _OFFSETS if 0 <= t + offset < len(frames)]
        laid = [_laid_over(frames[s], _chained(links, t, s)) for s in others]
        pictures = [picture for picture in laid if picture is not None]
        if len(pictures) < _MIN_SEEN:
            continue
        seen = np.stack([inside for _, inside in pictures])
        background = masked_median(np.stack([picture for picture, _ in pictures]), seen[..., None]).astype(np.uint8)
        known = seen.sum(0) >= _MIN_SEEN
        odds = Reference(background, np.full(known.shape, _NOISE_FLOOR, np.float32)).change(frames[t])
        out[t] = np.where(known, along_edges(odds, frames[t]), 0)
    return out


def odds_before(
    frames: UInt8[ndarray, "t h w 3"], depth: Float[Tensor, "t h w"], camera: CameraTrack
) -> Float32[ndarray, "t h w"]:
    """The same for a camera whose poses are known, with depth (m, 0 = unknown): without a rim of parallax.

    The background of a frame is what others show at its place, fused through the poses (`fused_frames`); what is
    clearly before it counts as moving, too.
    """
    sources = [Source.of(frame, depth[t], camera.select([t])) for t, frame in enumerate(frames)]
    difference = usual_difference([sources[t] for t in evenly(len(sources), _COMPARED).tolist()])
    tolerance, everywhere = tolerance_of(difference), evenly(len(frames), _ELSEWHERE).tolist()
    out = np.zeros(frames.shape[:3], np.float32)
    for t, source in enumerate(sources):
        near = {t + offset for offset in _OFFSETS if 0 <= t + offset < len(frames)}
        others = [sources[s] for s in sorted({*near, *everywhere} - {t})]
        if len(others) < _MIN_SEEN:
            continue
        background = fused(source, others, tolerance, exact=False)
        known = (background.seen >= _MIN_SEEN).numpy()
        noise = np.full(known.shape, _NOISE_FLOOR, np.float32)
        odds = Reference(np.where(known[..., None], background.rgb.numpy(), frames[t]), noise).change(frames[t])
        before = (source.depth > 0) & (source.depth < (1 - _NEARER * tolerance) * background.depth)
        out[t] = np.where(known, along_edges(odds + np.float32(_BY_DEPTH) * before.numpy(), frames[t]), 0)
    return out


def _homography(target: UInt8[ndarray, "h w"], source: UInt8[ndarray, "h w"]) -> Float64[ndarray, "3 3"] | None:
    """Pixels of the target -> pixels of the source, its neighbour, or None if too few corners agree."""
    corners = cv2.goodFeaturesToTrack(target, _CORNERS, 0.01, 7)
    if corners is None or len(corners) < _MIN_CORNERS:
        return None
    followed, status, _ = cv2.calcOpticalFlowPyrLK(target, source, corners, None, winSize=(21, 21), maxLevel=4)
    good = status[:, 0] > 0
    if good.sum() < _MIN_CORNERS:
        return None
    homography, agree = cv2.findHomography(corners[good], followed[good], cv2.RANSAC, _AGREE_PX)
    return homography if homography is not None and agree.sum() >= _MIN_CORNERS else None


def _chained(links: list[Float64[ndarray, "3 3"] | None], target: int, source: int) -> Float64[ndarray, "3 3"] | None:
    """Pixels of the target -> pixels of the source, through the frames between them; None if a link is missing."""
    chain = np.eye(3)
    for link in links[min(target, source) : max(target, source)]:
        if link is None:
            return None
        chain = link @ chain
    return chain if target < source else np.linalg.inv(chain)


def _laid_over(
    frame: UInt8[ndarray, "h w 3"], homography: Float64[ndarray, "3 3"] | None
) -> tuple[ndarray, ndarray] | None:
    """A frame as seen from another, and where it shows anything."""
    if homography is None:
        return None
    size = (frame.shape[1], frame.shape[0])
    picture = cv2.warpPerspective(frame, homography, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    inside = np.ones(frame.shape[:2], np.uint8)
    seen = cv2.warpPerspective(inside, homography, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
    return picture, seen > 0
