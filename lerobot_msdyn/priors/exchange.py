"""Priors as one npz file per episode and camera, so that any model, in any environment, can supply them.

docs/priors.md has the list of arrays. Everything is optional; what is there is checked before it is used.
"""

import json
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, Shaped, UInt8
from numpy import ndarray

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import Model, Priors, View
from lerobot_msdyn.priors.cache import save_npz
from lerobot_msdyn.priors.files import unreadable

DEPTH_KINDS = METRIC, SCALE, AFFINE_DISPARITY = "metric", "scale", "affine_disparity"
MAX_INSTANCE = 255
_MODEL = {"name": "model", "revision": "revision", "licence": "licence"}  # field of Model -> key of the provenance
_ASPECT = 0.01  # relative difference of the aspect ratio that rounding to whole pixels explains


@dataclass(frozen=True)
class Exchange:
    """The content of one file; positions and K are in pixels of an image of `height` by `width`."""

    frames: int
    height: int
    width: int
    episode: int | None = None
    camera: str | None = None
    masks: UInt8[ndarray, "t h w"] | None = None  # instance ids, 0 = background
    depth: Float32[ndarray, "t h w"] | None = None  # in the unit of depth_kind, 0 = unknown
    depth_kind: str = "metric"
    depth_conf: Float32[ndarray, "t h w"] | None = None  # 0..1
    tracks: Float32[ndarray, "n t 2"] | None = None  # px
    vis: Bool[ndarray, "n t"] | None = None
    conf: Float32[ndarray, "n t"] | None = None  # 0..1
    query_t: Int[ndarray, " n"] | None = None  # frame in which a track was asked for
    K: Float32[ndarray, "t 3 3"] | None = None  # px
    w2c: Float32[ndarray, "t 4 4"] | None = None  # camera from world, m
    world: str = ""  # name of w2c's world, where other files have the same; empty: it is this video's own
    provenance: dict[str, Any] = field(default_factory=dict)

    def model(self, prior: str) -> Model | None:
        """The learned model that a prior comes from, as far as the file states it."""
        entry = self.provenance.get(prior)
        stated = entry if isinstance(entry, dict) else {}
        named = {name: str(stated[key]) for name, key in _MODEL.items() if key in stated}
        return Model(**named) if named else None


def from_priors(view: View, priors: Priors, episode: int, camera: str) -> Exchange:
    """What is known about a video, as the content of a file."""
    pinhole = view.camera if priors.camera is None else priors.camera
    tracks = priors.tracks
    return Exchange(
        len(view.rgb),
        pinhole.height,
        pinhole.width,
        episode,
        camera,
        masks=priors.instances.numpy(),
        depth=priors.depth.numpy(),
        depth_kind="metric" if priors.metric else "scale",
        tracks=tracks.xy.numpy(),
        vis=tracks.visible.numpy(),
        conf=tracks.confidence.numpy(),
        query_t=tracks.visible.long().argmax(1).numpy(),
        K=pinhole.intrinsics.numpy(),
        w2c=pinhole.camera_from_world.numpy(),
        world=pinhole.world,
        provenance=priors.provenance,
    )


def write_exchange(path: Path, content: Exchange) -> None:
    """Write one file; it appears complete or not at all."""
    arrays: dict[str, Any] = {
        name: value
        for name, value in vars(content).items()
        if isinstance(value, ndarray) or (name in ("episode", "camera") and value is not None)
    }
    if content.depth is not None:
        arrays["depth_kind"] = content.depth_kind
    if content.world:
        arrays["world"] = content.world
    arrays["frames"], arrays["size"] = content.frames, np.array([content.height, content.width])
    arrays["provenance"] = json.dumps(content.provenance)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_npz(path, {name: np.asarray(value) for name, value in arrays.items()})


def read_exchange(
    path: Path, frames: int, height: int, width: int, episode: int | None = None, camera: str | None = None
) -> Exchange:
    """One file, checked against the video that it is meant for, and brought to the video's size.

    Raises:
        PriorError: the file cannot be read, is of another video, or holds something that cannot be used.
    """
    arrays = _load(path)
    _check_origin(path, arrays, frames, episode, camera)
    size = _size_of(path, arrays, height, width)
    _check_shapes(path, arrays, frames, size)
    _check_values(path, arrays)
    factor = np.array([width / size[1], height / size[0]], np.float32)

    def images(name: str) -> Shaped[ndarray, "t h w"] | None:
        return _resized(arrays[name], width, height) if name in arrays else None

    def plain(name: str, kind: type) -> ndarray | None:
        return arrays[name].astype(kind) if name in arrays else None

    tracks, intrinsics = plain("tracks", np.float32), plain("K", np.float32)
    if tracks is not None:
        tracks = np.nan_to_num(tracks) * factor
    if intrinsics is not None:
        intrinsics = np.broadcast_to(intrinsics, (frames, 3, 3)) * np.array([[*factor, 1]], np.float32).T
    return Exchange(
        frames,
        height,
        width,
        episode,
        camera,
        images("masks"),
        images("depth"),
        str(arrays.get("depth_kind", "metric")),
        images("depth_conf"),
        tracks,
        plain("vis", bool),
        plain("conf", np.float32),
        plain("query_t", np.int64),
        intrinsics,
        plain("w2c", np.float32),
        str(arrays.get("world", "")),
        _provenance(path, arrays),
    )


def _load(path: Path) -> dict[str, ndarray]:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, KeyError, EOFError, AttributeError, zipfile.BadZipFile, zlib.error) as error:
        raise unreadable(path, error) from error


def _check_origin(path: Path, arrays: dict[str, ndarray], frames: int, episode: int | None, camera: str | None) -> None:
    """Episode, camera and number of frames, as far as the file states them."""
    for name, expected in (("episode", episode), ("camera", camera)):
        if name in arrays and expected is not None and str(arrays[name]) != str(expected):
            raise PriorError(f"{path}: is of {name} {arrays[name]}, not {expected}: it belongs to another video")
    if "frames" in arrays and int(arrays["frames"]) != frames:
        raise PriorError(f"{path}: is of {int(arrays['frames'])} frames, the episode has {frames}: of another episode?")


def _size_of(path: Path, arrays: dict[str, ndarray], height: int, width: int) -> tuple[int, int]:
    """Height and width of the file's images."""
    size = next((arrays[name].shape[1:] for name in ("masks", "depth") if name in arrays), None)
    if "size" in arrays:
        size = tuple(int(value) for value in arrays["size"].reshape(-1))
    if size is None and not {"tracks", "K"} & set(arrays):
        return height, width
    if size is None or len(size) != 2 or min(size) < 1:
        raise PriorError(f"{path}: does not say of which size its images are; add size = [height, width] in pixels")
    if abs(size[1] / size[0] * height / width - 1) > _ASPECT + 1 / min(*size, height, width):
        raise PriorError(
            f"{path}: is of {size[1]}x{size[0]} pixels, the video of {width}x{height}: of another camera, or cropped?"
        )
    return size[0], size[1]


def _check_shapes(path: Path, arrays: dict[str, ndarray], frames: int, size: tuple[int, int]) -> None:
    count = len(arrays["tracks"]) if "tracks" in arrays and arrays["tracks"].ndim == 3 else -1
    expected = {
        "masks": (frames, *size),
        "depth": (frames, *size),
        "depth_conf": (frames, *size),
        "tracks": (count, frames, 2),
        "vis": (count, frames),
        "conf": (count, frames),
        "query_t": (count,),
        "K": (frames, 3, 3),
        "w2c": (frames, 4, 4),
    }
    for name, shape in expected.items():
        if name not in arrays or arrays[name].shape == shape or (name == "K" and arrays[name].shape == (3, 3)):
            continue
        wanted = ", ".join("n" if value < 0 else str(value) for value in shape)
        raise PriorError(f"{path}: {name} has shape {list(arrays[name].shape)}; expected [{wanted}]")
    if "tracks" in arrays and "vis" not in arrays:
        raise PriorError(f"{path}: has tracks without vis (bool [n, t]: in which frames a point is seen)")


def _check_values(path: Path, arrays: dict[str, ndarray]) -> None:
    numbers = {name: array for name, array in arrays.items() if name in _NUMBERS}
    for name, array in numbers.items():
        if array.dtype.kind not in "fiub":
            raise PriorError(f"{path}: {name} is of type {array.dtype}; expected numbers")
    if "masks" in arrays:
        masks = arrays["masks"]
        if masks.dtype.kind == "f" or (masks.size and (masks.min() < 0 or masks.max() > MAX_INSTANCE)):
            raise PriorError(
                f"{path}: masks are {masks.dtype}; expected instance ids, whole numbers 0 to {MAX_INSTANCE}"
            )
    if "tracks" in arrays:
        lost = ~np.isfinite(arrays["tracks"]).all(-1) & arrays["vis"].astype(bool)
        if lost.any():
            raise PriorError(f"{path}: {int(lost.sum())} visible positions of tracks are NaN or infinite")
    for name in ("K", "w2c", "conf", "depth_conf"):
        if name in arrays and not np.isfinite(arrays[name]).all():
            raise PriorError(f"{path}: {name} has NaN or infinite values")
    if "depth" in arrays and not (np.isfinite(arrays["depth"]) & (arrays["depth"] != 0)).any():
        raise PriorError(f"{path}: depth holds no measurement (every pixel is 0 or NaN)")
    kind = str(arrays.get("depth_kind", "metric"))
    if kind not in DEPTH_KINDS:
        raise PriorError(f"{path}: depth_kind is {kind!r}; expected one of {', '.join(DEPTH_KINDS)}")


_NUMBERS = ("masks", "depth", "depth_conf", "tracks", "vis", "conf", "query_t", "K", "w2c")


def _resized(images: Shaped[ndarray, "t h w"], width: int, height: int) -> Shaped[ndarray, "t H W"]:
    """Nearest pixels: neither ids nor depths may be mixed."""
    kind = np.uint8 if images.dtype.kind in "iub" else np.float32
    images = images.astype(kind)
    if images.shape[1:] == (height, width):
        return images
    size = (width, height)
    return np.stack([cv2.resize(image, size, interpolation=cv2.INTER_NEAREST_EXACT) for image in images])


def _provenance(path: Path, arrays: dict[str, ndarray]) -> dict[str, Any]:
    if "provenance" not in arrays:
        return {}
    try:
        content = json.loads(str(arrays["provenance"]))
    except ValueError as error:
        raise PriorError(f"{path}: provenance is not JSON ({error})") from error
    return content if isinstance(content, dict) else {"note": content}
