"""Held-out views of one episode in the folder of docs/evaluate.md: fitted, rendered, and scored where truth is there.

The fit reads nothing of `gt/` but the recorded camera; the truth is read after the views are rendered.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import torch
from jaxtyping import Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.augment.robot_cameras import NAME, calibrated
from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.dataset.read import open_source, read_episode
from lerobot_msdyn.dataset.select import select_cameras
from lerobot_msdyn.evaluate.asked import read_arrays, recorded_camera, recorded_dataset
from lerobot_msdyn.evaluate.config import EvaluateConfig
from lerobot_msdyn.evaluate.perceptual import SpatialNetwork, lpips_network, without_flip, without_lpips
from lerobot_msdyn.evaluate.scale import HeldOut, at_scale, fitted_scale
from lerobot_msdyn.evaluate.scores import (
    Evaluated,
    Scores,
    TrueViews,
    dynamic_psnr_db,
    mean_scores,
    score_table,
    score_views,
    source_shares,
)
from lerobot_msdyn.evaluate.timing import timed, timed_reconstruction
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.robots.seen import through
from lerobot_msdyn.views.pictures import new_pictures

ROBOT = "robot"  # folder of the output for what the robot's joints tell of the camera


def evaluate_nvs(config: EvaluateConfig) -> Evaluated:
    """Fit the episode and render its held-out cameras to `out`; scores per camera and their mean, written there too.

    Raises:
        DatasetError: a file of the folder is absent or not as documented.
        ConfigError: the weights for mLPIPS cannot be used, or a scale is to be fitted to a camera that moves.
    """
    seconds: dict[str, float] = {}
    with timed(seconds, "read"):
        view = read_view(config)
    config.priors.depth = config.depth_provider
    scene = timed_reconstruction(seconds, view, config)
    lpips = None if without_lpips(config.lpips_weights) else lpips_network(config.lpips_weights)
    cameras: dict[str, Scores] = {}
    held_out: dict[str, HeldOut] = {}
    pictures = 0
    for path in sorted((config.scene_folder / "gt" / "heldout").glob("*.npz")):
        with timed(seconds, "render"):
            camera, frames = _held_out_camera(scene, path)
            rendered = _render(scene, camera, frames)
            _write(rendered, frames, config.out / path.stem)
        pictures += len(rendered)
        with timed(seconds, "score"):
            truth = read_truth(config.scene_folder, path.stem)
            if truth is not None:
                cameras[path.stem] = score_views(rendered, truth, lpips)
                held_out[path.stem] = HeldOut(camera, frames, truth)
        if truth is not None and truth.moving is not None:
            with timed(seconds, "render without overlay, and by motion alone"):
                others = {"without_overlay": scene.without_overlay(), "by_motion": scene.by_motion_alone()}
                pictures_of = {name: _render(other, camera, frames) for name, other in others.items()}
            account = {f"dyn_psnr_{name}": dynamic_psnr_db(shown, truth) for name, shown in pictures_of.items()}
            cameras[path.stem] |= account | source_shares(scene, camera, frames, truth)
    rows = cameras | {"mean": mean_scores([*cameras.values()])}
    notices = (
        [without_flip(), without_lpips(config.lpips_weights)]
        if cameras
        else ["no scores: no true views with covis in gt/heldout"]
    )
    content: dict[str, Any] = {
        "scene": config.scene_folder.name,
        "cameras": cameras,
        "mean": rows["mean"],
        "pictures": pictures,
        "what_moves": scene.account.entry(),
    }
    if config.fit_scale and held_out:
        with timed(seconds, "scale"):
            content["scale"] = _at_fitted_scale(scene, held_out, lpips)
        factor = content["scale"]["factor"]
        rows[f"mean, depth x {factor:.3f}"] = content["scale"]["mean"]
        notices.append(f"depth x {factor:.3f}: one factor, fitted to the true views; all other rows are as they are")
    content |= {"seconds": seconds, "notices": [notice for notice in notices if notice]}
    return Evaluated(content, score_table(rows) if cameras else "", config.out).written()


def _at_fitted_scale(
    scene: Reconstruction, held_out: Mapping[str, HeldOut], lpips: SpatialNetwork | None
) -> dict[str, Any]:
    """The factor of all depths that fits the true views best, and the scores with it."""

    def rendered(view: HeldOut, camera: CameraTrack) -> UInt8[ndarray, "n h w 3"]:
        return _render(scene, camera, view.frames)

    factor = fitted_scale(scene.camera, [*held_out.values()], rendered)
    cameras = {
        name: score_views(rendered(view, at_scale(view.camera, scene.camera, view.frames, factor)), view.truth, lpips)
        for name, view in held_out.items()
    }
    return {"factor": factor, "cameras": cameras, "mean": mean_scores([*cameras.values()])}


def read_view(config: EvaluateConfig) -> View:
    """The recorded video with its true camera; with recorded depth where that is asked for.

    What a robot's joints tell of the camera, as in the job, is told of its links alone.
    """
    train = recorded_camera(config)
    source = open_source(*recorded_dataset(config))
    key = select_cameras(source, config.cameras)[0]
    (config.out / ROBOT / NAME).unlink(missing_ok=True)  # it may be another scene's
    found = calibrated(source, [0], [key], config, config.out / ROBOT)
    view = read_episode(source, 0, [key], found.camera, recorded_depth=config.depth == "recorded").views[key]
    height, width = view.rgb.shape[1:3]
    camera = _track(train, width, height)
    robot = None if view.robot is None or not camera.is_static else through(view.robot, view.camera, camera)
    return replace(view, camera=camera, robot=robot)


def read_truth(folder: Path, camera: str) -> TrueViews | None:
    """What a held-out camera truly saw; None where the pictures or `covis` are not there.

    Raises:
        DatasetError: a file cannot be read, or its parts do not belong together.
    """
    path = folder / "gt" / "heldout" / f"{camera}.npz"
    arrays = read_arrays(path, ("frame",), ("covis", "seg"))
    rgb = _true_pictures(path, arrays["frame"].tolist()) if "covis" in arrays else None
    if rgb is None:
        return None
    images = {name: np.moveaxis(arrays[name], -1, 0) for name in ("covis", "seg") if name in arrays}
    for name, image in images.items():
        if image.shape != rgb.shape[:3]:
            raise DatasetError(
                f"{path}: {name} is {list(image.shape)} with its last axis first; "
                f"expected {list(rgb.shape[:3])}, as the true pictures are"
            )
    moving = None
    meta = folder / "gt" / "meta.json"
    if "seg" in images and meta.is_file():
        moving = np.isin(images["seg"], _moving_bodies(meta))
    return TrueViews(rgb, images["covis"].astype(np.uint8), moving)


def _held_out_camera(scene: Reconstruction, path: Path) -> tuple[CameraTrack, Int[Tensor, " n"]]:
    """A held-out camera, at the size of the recorded one, and the frames that its poses belong to."""
    arrays = read_arrays(path, ("frame", "c2w", "K"))
    return _track(arrays, scene.camera.width, scene.camera.height), torch.as_tensor(arrays["frame"]).long()


def _render(scene: Reconstruction, camera: CameraTrack, frames: Int[Tensor, " n"]) -> UInt8[ndarray, "n h w 3"]:
    return np.stack([picture.rgb for picture in new_pictures(scene, camera, frames)])


def _write(pictures: UInt8[ndarray, "n h w 3"], frames: Int[Tensor, " n"], out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    for frame, picture in zip(frames.tolist(), pictures, strict=True):
        cv2.imwrite(str(out / f"rgb_{frame:04d}.png"), picture[..., ::-1])


def _track(arrays: dict[str, ndarray], width: int, height: int) -> CameraTrack:
    poses = torch.as_tensor(arrays["c2w"]).float()
    intrinsics = torch.as_tensor(arrays["K"]).float().expand(len(poses), 3, 3).contiguous()
    return CameraTrack(intrinsics, poses, width, height)


def _true_pictures(path: Path, frames: list[int]) -> UInt8[ndarray, "n h w 3"] | None:
    """From the lossless video beside the .npz file, else the folder of pictures; None if there is neither."""
    video, folder = path.with_suffix(".mkv"), path.with_suffix("")
    if video.is_file():
        try:
            with av.open(str(video)) as container:
                pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        except (av.FFmpegError, OSError) as error:
            raise DatasetError(f"{video}: cannot be decoded ({error})") from error
    elif folder.is_dir():
        files = [folder / f"rgb_{frame:04d}.png" for frame in frames]
        pictures = [picture for file in files if (picture := cv2.imread(str(file), cv2.IMREAD_COLOR_RGB)) is not None]
    else:
        return None
    if len(pictures) != len(frames):
        raise DatasetError(f"{path}: has {len(frames)} frames, the true pictures beside it are {len(pictures)}")
    return np.stack(pictures)


def _moving_bodies(meta: Path) -> list[int]:
    try:
        return [int(body) for body in json.loads(meta.read_text())["dynamic_ids"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{meta}: expected dynamic_ids, a list of body ids ({error})") from error
