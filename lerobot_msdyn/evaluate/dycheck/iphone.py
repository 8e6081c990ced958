"""Sequences in the layout of DyCheck's iPhone data, as it is or as Shape of Motion has processed it.

A sequence is a folder (Gao et al., "Monocular Dynamic View Synthesis: A Reality Check", NeurIPS 2022); pictures are
named `<camera>_<time>`: camera 0 is held in the hand and fitted, the others stand still and validate.

    camera/<id>.json                 orientation (rows: world to camera), position, focal_length and so on, at 1x;
                                     pixel centres at half-integers
    rgb/{1,2}x/<id>.png              RGBA; where LiDAR, which gives camera 0 its colours, has gaps: black, no alpha
    depth/{1,2}x/<id>.npy            [H, W, 1] z-depth of camera 0, m, 0 = unknown
    covisible/2x/val/<id>.png        255 where the training frames show a validation view
    splits/{train,val}.json          frame_names, time_ids; without the folder, from dataset.json and metadata.json
    flow3d_preprocessed/             Shape of Motion's: covisible/1x/val/, colmap/sparse/, colmap/scale.npy;
                                     optional: track_anything/, aligned_depth_anything_colmap/, 2d_tracks/, all at 1x

The center and scale of scene.json, which bring a scene into a box of diagonal 1, are not applied: all stays in metres.
"""

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.core.images import nearest_of
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.evaluate.config import Protocol
from lerobot_msdyn.evaluate.dycheck.splits import read_json, read_split
from lerobot_msdyn.priors.hub import demand_library

FACTOR: dict[Protocol, int] = {"som": 1, "dycheck": 2}  # by which pictures are smaller than the recorded ones
PROCESSED = "flow3d_preprocessed"
MILLIMETRES_FROM = 100.0  # a median depth above this cannot be metres
HALF = 127  # a mask's pixel, or alpha, above this says yes


class _Cameras(NamedTuple):
    """Of some pictures, as files have them."""

    intrinsics: Float[ndarray, "n 3 3"]  # px at 1x
    poses: Float[ndarray, "n 4 4"]  # world from camera, m
    sizes: Float[ndarray, "n 2"]  # width and height at 1x, px
    metres: float  # per unit of the files


@dataclass(frozen=True)
class IphoneSequence:
    """One sequence, as a protocol wants it."""

    root: Path
    protocol: Protocol
    view: View  # what is fitted; with LiDAR depth where that is there
    names: tuple[str, ...]  # of the fitted pictures
    validation: tuple[str, ...]  # pictures that are scored
    cameras: CameraTrack  # theirs
    frames: tuple[int, ...]  # the fitted picture of the same time (the nearest)
    metres: float  # per unit of the cameras' positions in the files; `view` and `cameras` are in m

    def true_picture(self, name: str) -> UInt8[ndarray, "h w 3"]:
        """What a validation camera saw."""
        return self._checked(self.root / "rgb" / f"{FACTOR[self.protocol]}x" / f"{name}.png")[..., :3]

    def covisible(self, name: str) -> Float[ndarray, "h w"]:
        """Which of it the training frames show, 0..1."""
        folder = "covisible/2x/val" if self.protocol == "dycheck" else f"{PROCESSED}/covisible/1x/val"
        mask = self._checked(self.root / folder / f"{name}.png")
        return (mask if mask.ndim == 2 else mask[..., 0]) / 255.0

    def _checked(self, path: Path) -> UInt8[ndarray, "h w *c"]:
        """A picture, which must be of the size of the fitted ones."""
        picture, expected = read_picture(path), tuple(self.view.rgb.shape[1:3])
        if picture.shape[:2] != expected:
            raise DatasetError(f"{path}: is {picture.shape[:2]} (height, width), the fitted pictures are {expected}")
        return picture


def read_sequence(root: Path, protocol: Protocol) -> IphoneSequence:
    """A sequence with the pictures and cameras of a protocol.

    Raises:
        DatasetError: a file is absent or not as described above.
        PriorError: pycolmap, which reads Shape of Motion's cameras, is not installed.
    """
    names, times = read_split(root, "train")
    validation, validation_times = read_split(root, "val")
    if not validation:
        raise DatasetError(f"{root}: splits/val.json names no picture: nothing to score (five sequences have some)")
    factor = FACTOR[protocol]
    rgb = np.stack([_recorded(read_picture(root / "rgb" / f"{factor}x" / f"{name}.png")) for name in names])
    height, width = rgb.shape[1:3]
    read = _colmap_cameras if protocol == "som" else _json_cameras
    intrinsics, poses, sizes, metres = read(root, [*names, *validation])
    wrong = np.flatnonzero((np.abs(sizes - factor * np.array((width, height))) >= factor).any(1))
    if len(wrong):
        first, (full_width, full_height) = [*names, *validation][wrong[0]], sizes[wrong[0]]
        raise DatasetError(
            f"{root}: the camera of {first} is one of {full_width:.0f}x{full_height:.0f} px, pictures in "
            f"rgb/{factor}x are {width}x{height}; expected them smaller by {factor}"
        )
    intrinsics[:, :2] /= factor
    track = CameraTrack(
        torch.from_numpy(intrinsics).float(), torch.from_numpy(poses).float(), width, height, "exchange"
    )
    nearest = np.abs(np.array(validation_times)[:, None] - np.array(times)).argmin(1)
    depth = _lidar(root / "depth" / f"{factor}x", names)
    if depth is not None and depth.shape != rgb.shape[:3]:
        raise DatasetError(f"{root}/depth/{factor}x: is {depth.shape[1:]}, the pictures are {rgb.shape[1:3]}")
    view = View(
        torch.from_numpy(rgb),
        track.select(slice(len(names))),
        None if depth is None else torch.from_numpy(depth),
    )
    cameras = track.select(slice(len(names), None))
    return IphoneSequence(
        root, protocol, view, tuple(names), tuple(validation), cameras, tuple(nearest.tolist()), metres
    )


def read_picture(path: Path) -> UInt8[ndarray, "h w *c"]:
    """An 8-bit picture: grey, RGB or RGBA."""
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.dtype != np.uint8:
        raise DatasetError(
            f"{path}: {'absent or no picture' if picture is None else f'is {picture.dtype}'}; expected 8 bit"
        )
    if picture.ndim == 2:
        return picture
    return np.ascontiguousarray(picture[..., [2, 1, 0, *range(3, picture.shape[2])]])


def read_array(path: Path) -> ndarray:
    """The numbers of a .npy file."""
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: cannot be read ({error}); expected a .npy file of numbers") from error


def _recorded(picture: UInt8[ndarray, "h w c"]) -> UInt8[ndarray, "h w 3"]:
    """Its colours; where alpha says that there is none, that of the nearest pixel."""
    rgb = picture[..., :3]
    seen = picture[..., 3] > HALF if picture.shape[2] > 3 else np.ones(rgb.shape[:2], bool)
    return rgb if seen.all() else rgb.reshape(-1, 3)[nearest_of(seen)]


def _json_cameras(root: Path, names: Sequence[str]) -> _Cameras:
    """Those of the sequence's own files."""
    intrinsics, poses = np.zeros((len(names), 3, 3)), np.tile(np.eye(4), (len(names), 1, 1))
    sizes = np.zeros((len(names), 2))
    for i, name in enumerate(names):
        path = root / "camera" / f"{name}.json"
        content = read_json(path)
        try:
            focal, (x, y) = content["focal_length"], content["principal_point"]
            ratio, skew = content.get("pixel_aspect_ratio", 1.0), content.get("skew", 0.0)
            intrinsics[i] = [[focal, skew, x], [0, focal * ratio, y], [0, 0, 1]]
            poses[i, :3, :3] = np.array(content["orientation"], float).T
            poses[i, :3, 3] = content["position"]
            sizes[i] = content["image_size"]
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(f"{path}: no camera of the kind that DyCheck uses ({error})") from error
    return _Cameras(intrinsics, poses, sizes, 1.0)


def _colmap_cameras(root: Path, names: Sequence[str]) -> _Cameras:
    """Those that Shape of Motion refined."""
    demand_library("pycolmap", "sfm", "protocol 'som'")
    import pycolmap

    folder = root / PROCESSED / "colmap"
    try:
        with tempfile.TemporaryDirectory(prefix="lerobot_msdyn_colmap_") as name:
            for file in ("cameras.bin", "images.bin", "points3D.bin"):
                if file == "points3D.bin" and not (folder / "sparse" / file).is_file():
                    Path(name, file).write_bytes(bytes(8))  # no points: COLMAP reads a model only as a whole
                else:
                    shutil.copyfile(folder / "sparse" / file, Path(name, file))
            model = pycolmap.Reconstruction(name)
    except (OSError, ValueError, RuntimeError) as error:
        raise DatasetError(
            f"{folder / 'sparse'}: no COLMAP model ({error}); --protocol som needs Shape of Motion's package, "
            "--protocol dycheck does not"
        ) from error
    metres = float(read_array(folder / "scale.npy").item())
    images = {image.name: image for image in model.images.values()}
    absent = [name for name in names if f"{name}.png" not in images]
    if absent:
        raise DatasetError(f"{folder / 'sparse'}: has no camera of {len(absent)} pictures, {absent[0]}.png among them")
    registered = [images[f"{name}.png"] for name in names]
    lenses = [model.cameras[image.camera_id] for image in registered]
    intrinsics = np.stack([lens.calibration_matrix() for lens in lenses])
    sizes = np.array([(lens.width, lens.height) for lens in lenses], float)
    poses = np.tile(np.eye(4), (len(names), 1, 1))
    poses[:, :3] = np.stack([image.cam_from_world().inverse().matrix() for image in registered])
    poses[:, :3, 3] *= metres
    return _Cameras(intrinsics, poses, sizes, metres)


def _lidar(folder: Path, names: Sequence[str]) -> Float[ndarray, "t h w"] | None:
    """LiDAR depth (m, 0 = unknown); None where there is none."""
    if not folder.is_dir():
        return None
    depth = np.stack([read_array(folder / f"{name}.npy").reshape(-1) for name in names])
    height, width = read_array(folder / f"{names[0]}.npy").shape[:2]
    depth = depth.reshape(len(names), height, width).astype(np.float32)
    measured = depth[depth > 0]
    if len(measured) and float(np.median(measured)) > MILLIMETRES_FROM:
        raise DatasetError(f"{folder}: depth of {np.median(measured):.0f} in the middle; expected metres")
    return depth
