"""What moves by itself and what stays, from point tracks: each track votes for the pixels that it passes.

A point that is ever carried along, looking the same, belongs to an object at all times; a point that stays put, or
whose place looks as before once the thing that seemed to carry it has passed, is background.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Int, UInt8
from numpy import ndarray

from lerobot_msdyn.core.observations import PointTracks
from lerobot_msdyn.priors.tracks.flow import flow_tracks
from lerobot_msdyn.priors.tracks.patches import sample

_TRACK_RESTART = 10  # frames
_MOVED_PX = 2.0  # a track that strays farther than this from its median position is carried by something
_MIN_STRAY_FRAMES = 3  # ... if it does so often enough
_MIN_REST_FRAMES = 8  # a track has a home if it stays within half of that for so long
_MIN_ALIKE_FRAMES = 3  # it was not carried if, while it strays, its home looks as before, or itself does not, so often
_SAME_TEXTURE = 8.0  # mean difference of grey levels, apart from brightness, up to which two patches look alike
_SAME_BRIGHTNESS = 8.0  # difference of mean grey levels that is allowed at the same place ...
_CARRIED_BRIGHTNESS = 30.0  # ... and on a surface that may have turned in the light
_HOME_PATCH = 7  # px
_TEXTURED = 1e-3  # smaller eigenvalue of the structure tensor, at which a track's vote counts half
_TRUSTED_FRAMES = 20  # a track's vote grows with its life up to this
_VOTE_SIGMA_PX = 3.0  # how far a track's vote reaches
AUDIBLE = 0.2 / (2 * np.pi * _VOTE_SIGMA_PX**2)  # a vote that counts: a fifth of one track at the pixel itself


def votes(
    frames: UInt8[ndarray, "t h w 3"], region: Bool[ndarray, "h w"]
) -> tuple[Float32[ndarray, "t h w"], Float32[ndarray, "t h w"]]:
    """For every pixel, how strongly tracks near it speak for something that moves, and for the background.

    Tracks are followed within a region only.
    """
    everywhere = torch.from_numpy(region.astype(np.uint8)).expand(len(frames), -1, -1).contiguous()
    tracks = flow_tracks(torch.from_numpy(frames), everywhere, restart_every=_TRACK_RESTART)
    return _vote(tracks, frames)


def _vote(
    tracks: PointTracks, frames: UInt8[ndarray, "t h w 3"]
) -> tuple[Float32[ndarray, "t h w"], Float32[ndarray, "t h w"]]:
    """For every pixel, how strongly the tracks near it speak for something that moves, and for the background."""
    xy, visible = tracks.xy.numpy(), tracks.visible.numpy()
    seen = np.where(visible[..., None], xy, np.nan)
    home = np.nanmedian(seen, axis=1) if len(xy) else np.zeros((0, 2), np.float32)
    away = np.where(visible, np.linalg.norm(xy - home[:, None], axis=-1), np.inf)
    at_home = away < 0.5 * _MOVED_PX
    strays = (visible & (away > _MOVED_PX)).sum(1) >= np.minimum(_MIN_STRAY_FRAMES, 1 + 0.05 * visible.sum(1))
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
