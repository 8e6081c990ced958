"""What moves, without learned weights: difference to the temporal median, corrected by a vote of point tracks.

The median alone goes wrong where an object rests for most of the clip: it is in the median, so it is missed while it
rests, and the place that it leaves shows up as moving afterwards. Tracks settle such places: a point that is ever
carried along, looking the same, belongs to an object at all times; a point that stays put, or whose place looks as
before once the thing that seemed to carry it has passed, is background.

Limits: what never moves in the clip is background, even a part of a thing that does (a robot's base, the resting half
of a cloth); something that comes to rest where no track can follow it there stays in the median if it rests long;
strong shadows on textured ground are partly taken for objects.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.priors.change import changes, to_lab
from lerobot_msdyn.priors.patches import sample
from lerobot_msdyn.priors.stabilise import camera_sway, to_frames, to_reference
from lerobot_msdyn.priors.tracks import flow_tracks
from lerobot_msdyn.priors.types import PointTracks

MAX_INSTANCES = 8
_MAX_WIDTH = 320  # px
_MEDIAN_SAMPLES = 60  # frames over which medians are taken
_NOISE_FLOOR = 1.0  # CIE Lab units
_TRACK_RESTART = 10  # frames, of the tracks that vote
_MOVED_PX = 2.0  # a track that strays farther than this from its median position is carried by something
_MIN_REST_FRAMES = 8  # a track has a home if it stays within half of that for so long
_MIN_ALIKE_FRAMES = 3  # it was not carried if, while it strays, its home looks as before, or itself does not, so often
_SAME_TEXTURE = 8.0  # mean difference of grey levels, apart from brightness, up to which two patches look alike
_SAME_BRIGHTNESS = 8.0  # difference of mean grey levels that is allowed at the same place ...
_CARRIED_BRIGHTNESS = 30.0  # ... and on a surface that may have turned in the light
_HOME_PATCH = 7  # px
_TEXTURED = 1e-3  # smaller eigenvalue of the structure tensor, at which a track's vote counts half
_TRUSTED_FRAMES = 20  # a track's vote grows with its life up to this
_VOTE_SIGMA_PX = 3.0  # how far a track's vote reaches
_MIN_VOTE = 0.2  # of one track at the pixel itself
_MIN_EMPTY_FRAMES = 5  # seen empty so often, a pixel's background is known
_MIN_AREA = 5e-4  # of the image; smaller blobs are dropped
_MIN_INSTANCE_AREA = 1e-3  # of the image, while it is seen; smaller instances are dropped
_MIN_LIFE = 5  # frames; instances seen in fewer are dropped


def temporal_median(rgb: UInt8[Tensor, "t h w 3"]) -> tuple[UInt8[Tensor, "h w 3"], Float32[Tensor, "h w"]]:
    """Median colour of every pixel, and its usual distance from it (CIE Lab units, with a floor).

    Over at most 60 evenly spread frames.
    """
    sample = _spread(len(rgb))
    frames = rgb.cpu().numpy()[sample]
    median = np.median(frames, axis=0).astype(np.uint8)
    reference = to_lab(median)
    distance = np.stack([np.linalg.norm(to_lab(frame) - reference, axis=-1) for frame in frames])
    noise = np.median(distance, axis=0).clip(min=_NOISE_FLOOR).astype(np.float32)
    return torch.from_numpy(median), torch.from_numpy(noise)


def empty_scene(
    rgb: UInt8[Tensor, "t h w 3"], instances: UInt8[Tensor, "t h w"], median: UInt8[Tensor, "h w 3"]
) -> UInt8[Tensor, "h w 3"]:
    """The temporal median over frames in which nothing moves at the pixel; the plain `median` where there is none."""
    mask = instances.cpu().numpy() > 0
    around = np.stack([cv2.dilate(m.astype(np.uint8), np.ones((5, 5), np.uint8)) for m in mask])
    return torch.from_numpy(_median_where(rgb.cpu().numpy(), around == 0, median.cpu().numpy()))


def moving_instances(
    rgb: UInt8[Tensor, "t h w 3"], median: UInt8[Tensor, "h w 3"], noise: Float32[Tensor, "h w"]
) -> UInt8[Tensor, "t h w"]:
    """Instance of every pixel: 0 = static, 1, 2, ... = things that move at some time of the clip, largest first.

    At most 8 instances, each followed by optical flow so that it keeps its number when it touches another. `median`
    and `noise` are those of `temporal_median`. Videos wider than 320 px are looked at in that width.
    """
    height, width = noise.shape
    size = (min(width, _MAX_WIDTH), max(1, round(height * min(1.0, _MAX_WIDTH / width))))

    def small(image: ndarray) -> ndarray:
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)

    frames = np.stack([small(frame) for frame in rgb.cpu().numpy()])
    empty, spread = small(median.cpu().numpy()), small(noise.cpu().numpy())
    sway = camera_sway(frames, empty)
    if sway is not None:
        frames = to_reference(frames, sway)
        steady, steady_noise = temporal_median(torch.from_numpy(frames))
        empty, spread = steady.numpy(), steady_noise.numpy()
    numbers = _number(_linked(frames, _moving_pixels(frames, empty, spread)))
    if sway is not None:
        numbers = to_frames(numbers, sway)
    if size == (width, height):
        return torch.from_numpy(numbers)
    return torch.from_numpy(np.stack([_enlarged(frame, (width, height)) for frame in numbers]))


def _enlarged(numbers: UInt8[ndarray, "h w"], size: tuple[int, int]) -> UInt8[ndarray, "H W"]:
    """Numbered regions at a larger size (width, height), with smooth outlines."""
    out, most = np.zeros(size[::-1], np.uint8), np.full(size[::-1], 0.5, np.float32)
    for number in np.unique(numbers[numbers > 0]):
        share = cv2.resize((numbers == number).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        out[share > most] = number
        most = np.maximum(most, share)
    return out


def _spread(frames: int) -> Int[ndarray, " s"]:
    return np.linspace(0, frames - 1, min(frames, _MEDIAN_SAMPLES)).round().astype(int)


def _moving_pixels(
    frames: UInt8[ndarray, "t h w 3"], median: UInt8[ndarray, "h w 3"], noise: Float32[ndarray, "h w"]
) -> Bool[ndarray, "t h w"]:
    """Pixels that show something that moves at some time of the clip, even while it rests."""
    changed = changes(frames, median, noise)
    region = _ever_changing(changed)
    if not region.any():
        return np.zeros(frames.shape[:3], bool)
    everywhere = torch.from_numpy(region.astype(np.uint8)).expand(len(frames), -1, -1).contiguous()
    tracks = flow_tracks(torch.from_numpy(frames), everywhere, restart_every=_TRACK_RESTART)
    for_moving, for_empty = _vote(tracks, frames)
    audible = _MIN_VOTE / (2 * np.pi * _VOTE_SIGMA_PX**2)
    empty = ~region | ((for_empty > 2 * for_moving) & (for_empty > audible))
    known = empty.sum(0) >= _MIN_EMPTY_FRAMES
    background = _median_where(frames, empty, median)
    voted = np.where(for_moving + for_empty > audible, for_moving > for_empty, changed)
    moving = np.where(known, changes(frames, background, noise), voted) & region
    return np.stack([_tidy(mask) for mask in moving])


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
    tidy = cv2.morphologyEx(tidy, cv2.MORPH_CLOSE, kernel, iterations=2)
    _, components, stats, _ = cv2.connectedComponentsWithStats(tidy, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= _MIN_AREA * mask.size
    large[0] = False
    return large[components]


def _vote(
    tracks: PointTracks, frames: UInt8[ndarray, "t h w 3"]
) -> tuple[Float32[ndarray, "t h w"], Float32[ndarray, "t h w"]]:
    """For every pixel, how strongly the tracks near it speak for something that moves, and for the background."""
    xy, visible = tracks.xy.numpy(), tracks.visible.numpy()
    seen = np.where(visible[..., None], xy, np.nan)
    home = np.nanmedian(seen, axis=1) if len(xy) else np.zeros((0, 2), np.float32)
    away = np.where(visible, np.linalg.norm(xy - home[:, None], axis=-1), np.inf)
    at_home = away < 0.5 * _MOVED_PX
    strays = (visible & (away > _MOVED_PX)).sum(1) > 0.05 * visible.sum(1)
    rests = at_home.sum(1) >= _MIN_REST_FRAMES
    elsewhere = away > _MOVED_PX
    images = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY).astype(np.float32) for frame in frames]
    patch = _rest_patches(images, home, at_home)
    returns = _times_alike(images, np.broadcast_to(home[:, None], xy.shape), patch, elsewhere, _SAME_BRIGHTNESS)
    carried = _times_alike(images, xy, patch, elsewhere & visible, _CARRIED_BRIGHTNESS)
    dragged = strays & rests & ((returns >= _MIN_ALIKE_FRAMES) | (carried < _MIN_ALIKE_FRAMES))
    weight = (np.minimum(visible.sum(1) / _TRUSTED_FRAMES, 1) * _texture(images, xy, visible))[:, None]
    for_moving = weight * (visible & (strays & ~dragged)[:, None])
    for_empty = weight * (at_home & (~strays | dragged)[:, None])
    return _density(xy, for_moving, frames.shape[1:3]), _density(xy, for_empty, frames.shape[1:3])


def _texture(
    images: list[ndarray], xy: Float32[ndarray, "n t 2"], visible: Bool[ndarray, "n t"]
) -> Float32[ndarray, " n"]:
    """How well each point can be followed, 0..1: where there is no texture, flow is that of the neighbourhood."""
    best = np.zeros(len(xy), np.float32)
    for t, image in enumerate(images):
        rows = np.nonzero(visible[:, t])[0]
        corners = cv2.cornerMinEigenVal(image / np.float32(255), 7, ksize=3)
        best[rows] = np.maximum(best[rows], sample(corners[..., None], xy[rows, t])[:, 0])
    return best / (best + _TEXTURED)


def _rest_patches(
    images: list[ndarray], home: Float32[ndarray, "n 2"], at_home: Bool[ndarray, "n t"]
) -> Float32[ndarray, "n p"]:
    """What each track rests on."""
    patch = np.zeros((len(home), _HOME_PATCH**2), np.float32)
    for t, image in enumerate(images):
        patch[at_home[:, t]] += _patches(image, home[at_home[:, t]])
    return patch / np.maximum(at_home.sum(1), 1)[:, None].astype(np.float32)


def _times_alike(
    images: list[ndarray],
    xy: Float32[ndarray, "n t 2"],
    patch: Float32[ndarray, "n p"],
    when: Bool[ndarray, "n t"],
    brightness: float,
) -> Int[ndarray, " n"]:
    """In how many of some frames the picture at some positions looks like a patch, up to some change of brightness."""
    times = np.zeros(len(patch), int)
    for t, image in enumerate(images):
        rows = np.nonzero(when[:, t])[0]
        difference = _patches(image, xy[rows, t]) - patch[rows]
        offset = difference.mean(1, keepdims=True)
        times[rows] += (np.abs(difference - offset).mean(1) < _SAME_TEXTURE) & (np.abs(offset[:, 0]) < brightness)
    return times


def _patches(image: Float32[ndarray, "h w"], xy: Float32[ndarray, "n 2"]) -> Float32[ndarray, "n p"]:
    if len(xy) == 0:
        return np.zeros((0, _HOME_PATCH**2), np.float32)
    offset = np.arange(_HOME_PATCH, dtype=np.float32) - _HOME_PATCH // 2
    dy, dx = np.meshgrid(offset, offset, indexing="ij")
    x, y = (xy.astype(np.float32) - 0.5).T
    at = x[:, None] + dx.reshape(1, -1), y[:, None] + dy.reshape(1, -1)
    return cv2.remap(image, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).reshape(len(xy), -1)


def _density(xy: Float32[ndarray, "n t 2"], weight: ndarray, shape: tuple[int, int]) -> Float32[ndarray, "t h w"]:
    """Weighted number of points per pixel, blurred to the reach of a vote."""
    out = np.zeros((xy.shape[1], *shape), np.float32)
    for t, image in enumerate(out):
        rows = np.nonzero(weight[:, t])[0]
        column, row = xy[rows, t].astype(int).T
        np.add.at(image, (row.clip(0, shape[0] - 1), column.clip(0, shape[1] - 1)), weight[rows, t])
        out[t] = cv2.GaussianBlur(image, (0, 0), _VOTE_SIGMA_PX)
    return out


def _median_where(
    frames: UInt8[ndarray, "t h w 3"], usable: Bool[ndarray, "t h w"], otherwise: UInt8[ndarray, "h w 3"]
) -> UInt8[ndarray, "h w 3"]:
    """Median colour of every pixel over the frames in which it is usable, or `otherwise`."""
    out = otherwise.copy()
    sample = _spread(len(frames))
    partly = usable[sample].any(0) & ~usable[sample].all(0)
    values = np.where(usable[sample][:, partly, None], frames[sample][:, partly], np.float32(np.nan))
    out[partly] = np.nanmedian(values, axis=0).round().astype(np.uint8) if partly.any() else out[partly]
    return out


def _linked(frames: UInt8[ndarray, "t h w 3"], moving: Bool[ndarray, "t h w"]) -> Int[ndarray, "t h w"]:
    """A number per moving thing, carried from frame to frame by optical flow; what flow does not reach is new."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    y, x = np.mgrid[: grey[0].shape[0], : grey[0].shape[1]].astype(np.float32)
    labels = np.zeros(moving.shape, np.int32)
    used = 0
    for t, mask in enumerate(moving):
        carried = np.zeros_like(labels[0])
        if t > 0 and labels[t - 1].any():
            flow = dis.calc(grey[t], grey[t - 1], None)
            before = labels[t - 1].astype(np.float32)
            carried = cv2.remap(before, x + flow[..., 0], y + flow[..., 1], cv2.INTER_NEAREST).astype(np.int32)
        count, components = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
        for component in range(1, count):
            inside = components == component
            known = carried * inside
            if known.any():
                labels[t][inside] = _nearest(known)[inside]
            else:
                used += 1
                labels[t][inside] = used
    return labels


def _nearest(labels: Int[ndarray, "h w"]) -> Int[ndarray, "h w"]:
    """Every pixel with the label of the nearest labelled one."""
    _, index = cv2.distanceTransformWithLabels(
        (labels == 0).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    lookup = np.zeros(index.max() + 1, labels.dtype)
    lookup[index[labels > 0]] = labels[labels > 0]
    return lookup[index]


def _number(labels: Int[ndarray, "t h w"]) -> UInt8[ndarray, "t h w"]:
    """The largest things as 1, 2, ...; what is small or short-lived is dropped."""
    area = np.stack([np.bincount(frame.ravel(), minlength=labels.max() + 1) for frame in labels])
    area[:, 0] = 0
    life = (area > 0).sum(0)
    lasting = (life >= min(_MIN_LIFE, len(labels))) & (
        area.sum(0) >= _MIN_INSTANCE_AREA * labels[0].size * np.maximum(life, 1)
    )
    order = np.argsort(-area.sum(0) * lasting, kind="stable")[: min(MAX_INSTANCES, int(lasting.sum()))]
    lookup = np.zeros(labels.max() + 1, np.uint8)
    lookup[order] = np.arange(1, len(order) + 1)
    return lookup[labels]
