"""Scenes with true held-out views for the ablation: synthetic ones, and simulated episodes (docs/evaluate.md)."""

from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
import torch
from corruptions import read_clip
from jaxtyping import Bool, Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.priors import PointTracks
from lerobot_msdyn.synthetic import SyntheticScene, covisibility, heldout_cameras, make_scene

TRUE_TRACKS = 3000
CAMERAS = ("az-10", "az+10", "el-08", "tx+05")  # of those that are held out


@dataclass(frozen=True)
class HeldOut:
    """A camera that was not recorded, at some frames: its true pictures, and what of them the recorded one has seen."""

    camera: CameraTrack  # one pose per frame
    frames: Int[ndarray, " f"]
    rgb: UInt8[ndarray, "f h w 3"]
    seen: UInt8[ndarray, "f h w"]  # 0 never, 1 at another time, 2 at the same time
    moving: Bool[ndarray, "f h w"]  # bodies that move at some time


@dataclass(frozen=True)
class Truth:
    """Priors without any error."""

    instances: UInt8[Tensor, "t h w"]
    tracks: PointTracks


@dataclass(frozen=True)
class Case:
    """A recorded video with depth, and held-out cameras."""

    name: str
    seed: int
    view: View
    heldout: tuple[HeldOut, ...]
    truth: Truth | None = None  # given: used instead of the project's own priors


def synthetic_case(kind: str, seed: int, frames: int, width: int, every: int, *, true_priors: bool = False) -> Case:
    """A synthetic scene of 4:3, its pictures as they are rendered (no codec); every `every`-th frame has truth."""
    scene = make_scene(kind, seed, frames, width, width * 3 // 4)
    recorded = scene.render(scene.camera)
    times = np.arange(every // 2, frames, every)
    heldout = []
    for name, camera in heldout_cameras(len(times), scene.camera.width, scene.camera.height).items():
        if name in CAMERAS:
            true = scene.render(camera, times.tolist())
            seen = covisibility(scene, recorded.depth.numpy(), camera, times.tolist())
            heldout.append(HeldOut(camera, times, true.rgb.numpy(), seen, true.instances.numpy() > 0))
    truth = Truth(recorded.instances, _true_tracks(scene)) if true_priors else None
    return Case(kind, seed, View(recorded.rgb, scene.camera, recorded.depth), tuple(heldout), truth)


def _true_tracks(scene: SyntheticScene) -> PointTracks:
    tracks = scene.tracks(TRUE_TRACKS, scene.seed)
    return PointTracks(tracks.xy, tracks.visible, tracks.visible.float(), tracks.instance)


def simulated_case(folder: Path, seed: int, width: int, stride: int, every: int) -> Case:
    """Every `stride`-th frame of a simulated episode at `width` px, and the truth of every `every`-th that has any."""
    view = read_clip(folder, stride, width)
    paths = [folder / "gt" / "heldout" / f"{name}.npz" for name in CAMERAS]
    with np.load(folder / "gt" / "bodies.npz", allow_pickle=False) as bodies:
        moving = bodies["dynamic"]
    heldout = tuple(_heldout(path, moving, view.camera, stride, every) for path in paths)
    return Case(folder.name, seed, view, heldout)


def _heldout(path: Path, moving: ndarray, recorded: CameraTrack, stride: int, every: int) -> HeldOut:
    size = (recorded.width, recorded.height)
    with np.load(path, allow_pickle=False) as truth:
        chosen = np.flatnonzero(truth["frame"] % stride == 0)[::every]
        frames = truth["frame"][chosen] // stride
        poses = torch.from_numpy(truth["c2w"][chosen]).float()
        intrinsics = torch.from_numpy(truth["K"]).float().expand(len(chosen), 3, 3).contiguous()
        seen, body = (np.moveaxis(truth[name][..., chosen], -1, 0) for name in ("covis", "seg"))
    with av.open(str(path.with_suffix(".mkv"))) as video:
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    rgb = np.stack([cv2.resize(pictures[i], size, interpolation=cv2.INTER_AREA) for i in chosen])

    def smaller(masks: ndarray) -> ndarray:
        return np.stack([cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) for mask in masks])

    camera = CameraTrack(intrinsics, poses, seen.shape[2], seen.shape[1]).resized(*size)
    return HeldOut(camera, frames, rgb, smaller(seen), np.isin(smaller(body), moving))
