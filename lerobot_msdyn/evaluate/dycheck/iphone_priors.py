"""What Shape of Motion's package knows of a sequence beyond its cameras: masks, aligned depth and tracks, if there."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.evaluate.dycheck.iphone import HALF, PROCESSED, IphoneSequence, read_array, read_picture
from lerobot_msdyn.priors.exchange import Exchange

QUERY_FRAMES = 12  # whose tracks are read; there is a file per pair of frames
TRACKS_PER_QUERY = 300
FAR_RATIO = 2.5  # depth is at most so many times the median, over frames, of the largest depth
NEAREST_DISPARITY = 1e-3


def read_priors(sequence: IphoneSequence, width: int) -> Exchange:
    """The content of an exchange file with pictures `width` pixels wide, with what of the three is there."""
    folder, names = sequence.root / PROCESSED, sequence.names
    frames, full_height, full_width = sequence.view.rgb.shape[:3]
    size = (min(width, full_width), round(full_height * min(width, full_width) / full_width))
    masks, depth = folder / "track_anything" / "1x", folder / "aligned_depth_anything_colmap" / "1x"
    tracks = folder / "2d_tracks" / "1x"
    arrays: dict[str, Any] = {}
    if masks.is_dir():
        arrays["masks"] = np.stack([_mask(masks / f"{name}.png", size) for name in names])
    if depth.is_dir():
        arrays["depth"] = _depth([depth / f"{name}.npy" for name in names], size) * np.float32(sequence.metres)
    if tracks.is_dir():
        arrays |= _tracks(tracks, names)
        arrays["tracks"] = arrays["tracks"] * np.float32(size[0] / full_width)
    return Exchange(frames, size[1], size[0], **arrays)


def _mask(path: Path, size: tuple[int, int]) -> UInt8[ndarray, "h w"]:
    picture = read_picture(path)
    mask = picture if picture.ndim == 2 else picture[..., 0]
    return cv2.resize((mask > HALF).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT)


def _depth(paths: Sequence[Path], size: tuple[int, int]) -> Float32[ndarray, "t h w"]:
    """Depth, in the unit of the cameras' files, from files of disparity [H, W]."""
    disparity = [cv2.resize(read_array(path), size, interpolation=cv2.INTER_NEAREST_EXACT) for path in paths]
    depth = 1 / np.maximum(np.stack(disparity).astype(np.float32), NEAREST_DISPARITY)
    return np.minimum(depth, FAR_RATIO * np.median(depth.max((1, 2))))


def _tracks(folder: Path, names: Sequence[str]) -> dict[str, ndarray]:
    """Positions (px at 1x, pixel centres at half-integers) of points asked for in some frames, at all frames.

    A file per frame asked for and frame looked at: [n, 4] x, y (the first pixel's centre at 0), logits of being hidden
    and of being off. A point is seen where (1 - hidden) (1 - off) > 0.5.
    """
    positions, seen, sure, asked = [], [], [], []
    for query in evenly(len(names), QUERY_FRAMES).tolist():
        files = [read_array(folder / f"{names[query]}_{name}.npy").astype(np.float32) for name in names]
        if len({file.shape for file in files}) > 1 or files[0].ndim != 2 or files[0].shape[1] != 4:
            raise DatasetError(f"{folder}/{names[query]}_*.npy: files of tracks differ in shape, or are not [n, 4]")
        kept = np.stack(files, axis=1)[:: max(1, len(files[0]) // TRACKS_PER_QUERY)]
        shown, accurate = _not(kept[..., 2]), _not(kept[..., 3])
        positions.append(kept[..., :2] + 0.5)
        seen.append(shown * accurate > 0.5)
        sure.append(shown * accurate)
        asked.append(np.full(len(kept), query))
    return {
        "tracks": np.concatenate(positions),
        "vis": np.concatenate(seen),
        "conf": np.concatenate(sure),
        "query_t": np.concatenate(asked),
    }


def _not(logit: Float32[ndarray, "n t"]) -> Float32[ndarray, "n t"]:
    """One less the probability that a logit stands for."""
    return 1 / (1 + np.exp(logit.clip(-60, 60)))
