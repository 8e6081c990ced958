"""What moves, without learned weights: difference to a picture of the empty scene, which is mended step by step.

The temporal median goes wrong where an object rests for most of the clip: it is in the median, so it is missed while
it rests, and the place that it leaves shows up as moving afterwards. Votes of point tracks (`votes`) and the outlines
of such places (`ghosts`) mend it. A pixel is judged by its difference to that picture (`change`) where the picture is
known, else by the votes, and everywhere by the colours of what moves; neighbours decide together within the edges of
the frame.

Limits: what never moves in the clip is background, even a part of a thing that does (a robot's base, the resting half
of a cloth); something that comes to rest where no track can follow it there stays in the median if it rests long; a
thing of the colour and texture of its ground is missed.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.images import box_about
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.priors.camera.steadiness import SWAY_PX, camera_motion_px
from lerobot_msdyn.priors.masks.change import Colours, Reference, along_edges, changes, to_lab
from lerobot_msdyn.priors.masks.ghosts import median_where, without_ghosts
from lerobot_msdyn.priors.masks.linking import numbered
from lerobot_msdyn.priors.masks.stabilise import camera_sway, to_frames, to_reference
from lerobot_msdyn.priors.masks.votes import AUDIBLE, votes
from lerobot_msdyn.priors.masks.wandering import odds_before, residual_odds
from lerobot_msdyn.render.cpu.threads import in_threads

_MAX_WIDTH = 320  # px
_MEDIAN_SAMPLES = 60  # frames over which medians are taken
_NOISE_FLOOR = 1.0  # CIE Lab units
_MEND_SAMPLES = 60  # frames from which the picture of the empty scene is mended ...
_MEND_PASSES = 2  # ... so often
_MIN_EMPTY_FRAMES = 5  # seen empty so often, a pixel's background is known
_SURELY_EMPTY = -1.0  # log-odds below which a pixel serves for the picture of the empty scene
_SURE = 3.0  # log-odds beyond which a pixel serves to learn colours
_MOST_BY_VOTE = 4.0  # log-odds
_SELDOM = 0.05  # share of the frames; a pixel that changes in fewer may be static
_MIN_AREA = 5e-4  # of the image; smaller blobs are dropped


def median_picture(frames: UInt8[Tensor, "t h w 3"]) -> UInt8[Tensor, "h w 3"]:
    """Median colour of every pixel over at most 60 evenly spread frames."""
    return torch.from_numpy(np.median(_spread(frames.cpu().numpy(), _MEDIAN_SAMPLES), axis=0).astype(np.uint8))


def temporal_median(
    rgb: UInt8[Tensor, "t h w 3"], others: UInt8[Tensor, "m h w 3"] | None = None
) -> tuple[UInt8[Tensor, "h w 3"], Float32[Tensor, "h w"]]:
    """Median colour of every pixel, and its usual distance from it (CIE Lab units, with a floor).

    Over at most 60 evenly spread frames, and as many of `others`: frames of other episodes of the same fixed camera.
    """
    frames = _spread(rgb.cpu().numpy(), _MEDIAN_SAMPLES)
    if others is not None:
        frames = np.concatenate((frames, _spread(others.cpu().numpy(), _MEDIAN_SAMPLES)))
    median = np.median(frames, axis=0).astype(np.uint8)
    reference = to_lab(median)
    distance = np.stack([np.linalg.norm(to_lab(frame) - reference, axis=-1) for frame in frames])
    noise = np.median(distance, axis=0).clip(min=_NOISE_FLOOR).astype(np.float32)
    return torch.from_numpy(median), torch.from_numpy(noise)


def moving_instances(
    rgb: UInt8[Tensor, "t h w 3"],
    median: UInt8[Tensor, "h w 3"],
    noise: Float32[Tensor, "h w"],
    others: UInt8[Tensor, "m h w 3"] | None = None,
    sway_px: float = SWAY_PX,
) -> UInt8[Tensor, "t h w"]:
    """Instance of every pixel: 0 = static, 1, 2, ... = things that move at some time of the clip, largest first.

    At most 8 instances, each followed by optical flow so that it keeps its number when it touches another. `median`
    and `noise` are those of `temporal_median`; `others` are frames of other episodes of the same fixed camera, which
    show places that this one hides. Before a camera that moves by more than `sway_px` (`camera_motion_px`) what differs
    from the background of the neighbouring frames moves (`wandering`). Videos wider than 320 px are looked at in that
    width.
    """
    height, width = noise.shape
    size = (min(width, _MAX_WIDTH), max(1, round(height * min(1.0, _MAX_WIDTH / width))))

    def small(images: ndarray) -> ndarray:
        return np.stack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images])

    frames, (empty,), (spread,) = (
        small(rgb.cpu().numpy()),
        small(median[None].cpu().numpy()),
        small(noise[None].numpy()),
    )
    if camera_motion_px(torch.from_numpy(frames)) > sway_px:
        moving = np.stack([_tidy(odds > 0) for odds in residual_odds(frames)])
        return torch.from_numpy(_at_size(numbered(frames, moving), (width, height)))
    elsewhere = frames[:0] if others is None else small(_spread(others.cpu().numpy(), _MEDIAN_SAMPLES))
    sway = camera_sway(np.concatenate((frames, elsewhere)), empty)
    if sway is not None:
        frames, elsewhere = to_reference(frames, sway[: len(frames)]), to_reference(elsewhere, sway[len(frames) :])
        steady, steady_noise = temporal_median(torch.from_numpy(frames), torch.from_numpy(elsewhere))
        empty, spread = steady.numpy(), steady_noise.numpy()
    numbers = numbered(frames, _moving_pixels(frames, elsewhere, empty, spread))
    if sway is not None:
        numbers = to_frames(numbers, sway[: len(frames)])
    return torch.from_numpy(_at_size(numbers, (width, height)))


def instances_before(
    rgb: UInt8[Tensor, "t h w 3"], depth: Float[Tensor, "t h w"], camera: CameraTrack
) -> UInt8[Tensor, "t h w"]:
    """As `moving_instances`, before a camera that moves and whose poses are known, with depth (m, 0 = unknown)."""
    height, width = rgb.shape[1:3]
    small = View(rgb, camera, depth).shrunk(_MAX_WIDTH)
    assert small.depth is not None
    frames = small.rgb.numpy()
    moving = np.stack([_tidy(odds > 0) for odds in odds_before(frames, small.depth, small.camera)])
    return torch.from_numpy(_at_size(numbered(frames, moving), (width, height)))


def _at_size(numbers: UInt8[ndarray, "t h w"], size: tuple[int, int]) -> UInt8[ndarray, "t H W"]:
    """Numbered regions of all frames at a size (width, height)."""
    if size == (numbers.shape[2], numbers.shape[1]):
        return numbers
    return np.stack([_enlarged(frame, size) for frame in numbers])


def _enlarged(numbers: UInt8[ndarray, "h w"], size: tuple[int, int]) -> UInt8[ndarray, "H W"]:
    """Numbered regions at a larger size (width, height), with smooth outlines."""
    out, most = np.zeros(size[::-1], np.uint8), np.full(size[::-1], 0.5, np.float32)
    for number in np.unique(numbers[numbers > 0]):
        coverage = cv2.resize((numbers == number).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        out[coverage > most] = number
        most = np.maximum(most, coverage)
    return out


def _spread(frames: ndarray, most: int) -> ndarray:
    """At most so many of the frames, evenly spread."""
    return frames[_spread_index(len(frames), most)]


def _spread_index(frames: int, most: int) -> Int[ndarray, " s"]:
    return evenly(frames, most).numpy()


def _moving_pixels(
    frames: UInt8[ndarray, "t h w 3"],
    elsewhere: UInt8[ndarray, "m h w 3"],
    median: UInt8[ndarray, "h w 3"],
    noise: Float32[ndarray, "h w"],
) -> Bool[ndarray, "t h w"]:
    """Pixels that show something that moves at some time of the clip, even while it rests."""
    changed = changes(frames, median, noise)
    region = _ever_changing(changed)
    if not region.any():
        return changed & False
    for_moving, for_empty = votes(frames, region)
    box = box_about(region)
    moving = np.zeros_like(changed)
    moving[:, *box] = _mended(
        frames[:, *box],
        elsewhere[:, *box],
        median[box],
        noise[box],
        region[box],
        changed[:, *box],
        for_moving[:, *box],
        for_empty[:, *box],
    )
    return moving


def _mended(
    frames: UInt8[ndarray, "t h w 3"],
    elsewhere: UInt8[ndarray, "m h w 3"],
    empty: UInt8[ndarray, "h w 3"],
    noise: Float32[ndarray, "h w"],
    region: Bool[ndarray, "h w"],
    changed: Bool[ndarray, "t h w"],
    for_moving: Float32[ndarray, "t h w"],
    for_empty: Float32[ndarray, "t h w"],
) -> Bool[ndarray, "t h w"]:
    """Pixels that move, from a first guess of the empty scene and of what differs from it."""
    voted = np.log((for_moving + AUDIBLE / 4) / (for_empty + AUDIBLE / 4)).clip(-_MOST_BY_VOTE, _MOST_BY_VOTE)
    never = changed.mean(0) < _SELDOM
    bare = ~region | ((for_empty > 2 * for_moving) & (for_empty > AUDIBLE)) | (never & (for_empty >= for_moving))
    empty, known = _median_where(frames, bare, empty), bare.sum(0) >= _MIN_EMPTY_FRAMES
    chosen = _spread_index(len(frames), _MEND_SAMPLES)
    studied = np.concatenate((frames[chosen], elsewhere))
    hints = np.concatenate((voted[chosen], np.zeros(elsewhere.shape[:3], np.float32)))
    for _ in range(_MEND_PASSES):
        odds, colours = _judged(studied, hints, empty, known, noise, region)
        moving = np.stack([_tidy(image > 0) for image in odds[: len(chosen)]])
        mended, ghost = without_ghosts(studied[: len(chosen)], moving, empty, len(frames) / len(chosen))
        bare = np.stack(
            [cv2.dilate((o > _SURELY_EMPTY).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0 for o in odds]
        )
        empty = np.where(ghost[..., None], mended, _median_where(studied, bare, empty))
        known = ghost | (bare.sum(0) >= _MIN_EMPTY_FRAMES)
    reference = Reference(empty, noise)

    def moving_at(frame: tuple[ndarray, ndarray]) -> Bool[ndarray, "h w"]:
        return _tidy(_odds(*frame, known, reference.change(frame[0]), colours) > 0)

    return np.stack([*in_threads(moving_at, zip(frames, voted, strict=True))])


def _odds(
    frame: UInt8[ndarray, "h w 3"],
    vote: Float32[ndarray, "h w"],
    known: Bool[ndarray, "h w"],
    difference: Float32[ndarray, "h w"],
    colours: Colours,
) -> Float32[ndarray, "h w"]:
    """Log-odds that a pixel belongs to something that moves."""
    return along_edges(np.where(known, difference, vote) + colours.odds(frame), frame)


def _judged(
    frames: UInt8[ndarray, "s h w 3"],
    voted: Float32[ndarray, "s h w"],
    empty: UInt8[ndarray, "h w 3"],
    known: Bool[ndarray, "h w"],
    noise: Float32[ndarray, "h w"],
    region: Bool[ndarray, "h w"],
) -> tuple[Float32[ndarray, "s h w"], Colours]:
    """Log-odds that each pixel belongs to something that moves, and the colours that were learnt on the way."""
    reference, colours = Reference(empty, noise), Colours()
    differences = [*in_threads(reference.change, frames)]
    for frame, difference in zip(frames, differences, strict=True):
        colours.add(frame, np.where(known & region, difference, 0), _SURE)

    def odds_at(frame: tuple[ndarray, ndarray, ndarray]) -> Float32[ndarray, "h w"]:
        picture, vote, difference = frame
        return _odds(picture, vote, known, difference, colours)

    return np.stack([*in_threads(odds_at, zip(frames, voted, differences, strict=True))]), colours


def _ever_changing(changed: Bool[ndarray, "t h w"]) -> Bool[ndarray, "h w"]:
    """Everything that changes at some time, without gaps and with a margin."""
    ever = cv2.morphologyEx((changed.sum(0) >= 2).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    ever = cv2.morphologyEx(ever, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
    outlines, _ = cv2.findContours(ever, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = cv2.drawContours(ever.copy(), outlines, -1, 1, cv2.FILLED)
    return cv2.dilate(filled, np.ones((9, 9), np.uint8)) > 0


def _tidy(mask: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Without specks, gaps and small blobs."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    tidy = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    tidy = cv2.morphologyEx(tidy, cv2.MORPH_CLOSE, kernel)
    _, components, stats, _ = cv2.connectedComponentsWithStats(tidy, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= _MIN_AREA * mask.size
    large[0] = False
    return large[components]


def _median_where(
    frames: UInt8[ndarray, "t h w 3"], usable: Bool[ndarray, "t h w"], otherwise: UInt8[ndarray, "h w 3"]
) -> UInt8[ndarray, "h w 3"]:
    """Median colour of the pixels that are usable in some frames, but not in all; elsewhere `otherwise`."""
    sample = _spread_index(len(frames), _MEDIAN_SAMPLES)
    return median_where(frames[sample], usable[sample], ~usable[sample].all(0), otherwise)
