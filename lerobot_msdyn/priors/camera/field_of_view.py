"""The focal length at which rigid things keep their size, where depth is known.

The squared distance of two points of a rigid thing does not change. Lifted by their depth it is L / f² + D, with L from
their pixels times depth and D from their depths alone. While the thing turns, one grows as the other shrinks: 1 / f²
is the slope. A thing that only slides tells nothing, which shows as a poor correlation of the two; of several things
the one with the best correlation decides.
"""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int
from numpy import ndarray

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import Origin, PointTracks
from lerobot_msdyn.priors.registry import Depth

_PAIRS = 4000
_MIN_PAIRS = 50
_MIN_FRAMES = 10  # in which both points of a pair are seen
_MIN_CORRELATION = 0.7
_STEPS = 20
_FOV_DEG = (20.0, 140.0)  # a result beyond is taken for a failure


def with_searched_fov(camera: CameraTrack, tracks: PointTracks, depth: Depth) -> tuple[CameraTrack, Origin]:
    """The camera with the field of view at which rigid things keep their size.

    Raises:
        PriorError: the depth is assumed, or nothing turns enough to tell.
    """
    if depth.traits.assumed:
        raise PriorError(
            "camera.fov_search needs depth that does not depend on the field of view: recorded, learned or from a file"
        )
    fov, correlation = fov_from_rigid_motion(tracks, depth.z.numpy(), camera)
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = intrinsics_from_fov(camera.width, camera.height, fov)[0, 0]
    why = f"rigid things keep their size at {fov:.1f} degrees (correlation {correlation:.2f})"
    return replace(camera, intrinsics=intrinsics, origin="fov_search"), Origin("fov_search", why)


def fov_from_rigid_motion(
    tracks: PointTracks, depth: Float32[ndarray, "t h w"], camera: CameraTrack
) -> tuple[float, float]:
    """Horizontal field of view in degrees, and the correlation (0..1) by which to trust it.

    Raises:
        PriorError: nothing turns enough to tell.
    """
    xy, z = tracks.xy.numpy(), _depth_at(tracks.xy.numpy(), depth)
    known = tracks.visible.numpy() & (z > 0)
    scaled = (xy - camera.intrinsics[0, :2, 2].numpy()) * z[..., None]
    best, slope = 0.0, 0.0
    for number in np.unique(tracks.instance.numpy()):
        pairs = _pairs(np.nonzero(tracks.instance.numpy() == number)[0], xy, known)
        if len(pairs) >= _MIN_PAIRS:
            lateral, along = _changes(scaled, z, known, pairs)
            candidate = _robust_slope(lateral, -along)
            correlation = _correlation(lateral, -along, candidate)
            best, slope = max((best, slope), (correlation, candidate))
    fov = 2 * math.degrees(math.atan(0.5 * camera.width * math.sqrt(max(slope, 0.0))))
    if best < _MIN_CORRELATION or not _FOV_DEG[0] < fov < _FOV_DEG[1]:
        raise PriorError(
            f"the field of view cannot be found from what moves (correlation {best:.2f}, expected "
            f"{_MIN_CORRELATION} or more): nothing rigid turns enough; give it by --camera.horizontal_fov_deg"
        )
    return fov, best


def _depth_at(xy: Float32[ndarray, "n t 2"], depth: Float32[ndarray, "t h w"]) -> Float32[ndarray, "n t"]:
    frames, height, width = depth.shape
    column, row = xy[..., 0].astype(int).clip(0, width - 1), xy[..., 1].astype(int).clip(0, height - 1)
    return depth[np.arange(frames), row, column]


def _pairs(rows: Int[ndarray, " k"], xy: Float32[ndarray, "n t 2"], known: Bool[ndarray, "n t"]) -> Int[ndarray, "m 2"]:
    """Random pairs of some points that are seen together for long enough; of those the wider half."""
    pairs = rows[np.random.default_rng(0).integers(0, len(rows), (_PAIRS, 2))]
    together = known[pairs[:, 0]] & known[pairs[:, 1]]
    enough = (together.sum(1) >= _MIN_FRAMES) & (pairs[:, 0] != pairs[:, 1])
    pairs, together = pairs[enough], together[enough]
    width = np.linalg.norm(xy[pairs[:, 0]] - xy[pairs[:, 1]], axis=-1)
    typical = (width * together).sum(1) / np.maximum(together.sum(1), 1)
    return pairs[typical >= np.median(typical)] if len(pairs) else pairs


def _changes(
    scaled: Float32[ndarray, "n t 2"],
    z: Float32[ndarray, "n t"],
    known: Bool[ndarray, "n t"],
    pairs: Int[ndarray, "m 2"],
) -> tuple[Float64[ndarray, "m t"], Float64[ndarray, "m t"]]:
    """Of each pair's squared distances across the axis (px² m²) and along it (m²): the difference to the usual one.

    In units of the pair's own size, so that far points do not count more than near ones; 0 where it is not seen.
    """
    a, b = pairs.T
    together = known[a] & known[b]
    out = []
    for squares in (
        np.square(scaled[a] - scaled[b], dtype=np.float64).sum(-1),
        np.square(z[a] - z[b], dtype=np.float64),
    ):
        middle = (squares * together).sum(1) / np.maximum(together.sum(1), 1)
        out.append(np.where(together, squares - middle[:, None], 0))
    size = np.maximum(
        (np.square(scaled[a] - scaled[b]).sum(-1) * together).sum(1) / np.maximum(together.sum(1), 1), 1e-9
    )
    return out[0] / size[:, None], out[1] / size[:, None]


def _robust_slope(x: Float64[ndarray, "m t"], y: Float64[ndarray, "m t"]) -> float:
    """Slope through the origin by least absolute differences per pair: parts that are not rigid are outliers."""
    weight = np.ones(len(x))
    slope = 0.0
    for _ in range(_STEPS):
        slope = float((weight * (x * y).sum(1)).sum() / max((weight * (x * x).sum(1)).sum(), 1e-30))
        off = np.sqrt(np.square(y - slope * x).sum(1))
        weight = 1 / np.maximum(off, 1e-3 * np.median(off) + 1e-30)
    return slope


def _correlation(x: Float64[ndarray, "m t"], y: Float64[ndarray, "m t"], slope: float) -> float:
    """Between the two, over the better half of the pairs."""
    off = np.square(y - slope * x).sum(1) / np.maximum(np.square(y).sum(1), 1e-30)
    best = np.argsort(off)[: max(1, len(off) // 2)]
    x, y = x[best], y[best]
    return float((x * y).sum() / max(np.sqrt((x * x).sum() * (y * y).sum()), 1e-30))
