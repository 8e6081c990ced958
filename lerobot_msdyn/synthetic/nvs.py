"""A scene with its true held-out views as a folder, for scorers that know nothing of this package.

    dataset/, dataset_depth/       LeRobot v3.0, without and with recorded depth
    gt/meta.json                   K, fps, held-out camera names, body names by segmentation id, ids of moving bodies
    gt/train.npz                   depth uint16 [H, W, F] x 0.1 mm (z-depth), seg uint8 [H, W, F], K [3, 3],
                                   c2w [F, 4, 4]
    gt/robot.npz                   state, action [F, 6]
    gt/bodies.npz                  pose [F, B, 7] (xyz, quaternion wxyz, body-to-world), names, dynamic ids,
                                   flex_verts [F, V, 3] and flex_faces [., 3] of the sheet
    gt/tracks.npz                  xyz [F, P, 3] world, uv [F, P, 2] px, visible [F, P], body [P], query_frame [P]
    gt/heldout/<cam>.npz           frame [N], c2w [N, 4, 4], K [3, 3], seg [H, W, N], covis [H, W, N]
    gt/heldout/<cam>/rgb_%04d.png  the true views, by frame; the same in order, lossless, in gt/heldout/<cam>.mkv

Time is the last axis of the image arrays. covis: 0 = never seen by the recorded camera, 1 = seen at another time,
2 = seen at the same time; points move with their body.
"""

import json
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import torch

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import ConfigError, OutputError
from lerobot_msdyn.core.geometry import matrix_to_quaternion
from lerobot_msdyn.render.cpu.threads import in_threads
from lerobot_msdyn.synthetic import dataset
from lerobot_msdyn.synthetic.raycast import mark_covisible
from lerobot_msdyn.synthetic.scene import SyntheticScene, SyntheticView, pinhole
from lerobot_msdyn.synthetic.viewpoints import heldout_cameras

DEPTH_UNIT = 1e-4  # m
TRACKS = 200


def write_nvs_folder(scene: SyntheticScene, root: Path, every: int = 5, rgb_encoder: Any = None) -> None:
    """Writes the folder described above; every `every`-th frame is rendered from each held-out camera.

    Raises:
        ConfigError: `every` is not positive.
        OutputError: `root` exists.
    """
    if every < 1:
        raise ConfigError(f"every must be at least 1 frame, got {every}")
    if root.exists():
        raise OutputError(f"{root} exists already; remove it or choose another folder for the synthetic scene")
    recorded = scene.render(scene.camera)
    for name, depth in (("dataset", False), ("dataset_depth", True)):
        features = dataset.features_of(scene, ("front",), depth=depth, image_dtype="video")
        episode = (scene, {"front": recorded})
        dataset.record(
            [episode], features, f"synthetic/{root.name}", root / name, fps=scene.fps, rgb_encoder=rgb_encoder
        )
    truth = root / "gt"
    (truth / "heldout").mkdir(parents=True)
    frames = list(range(0, len(scene), every))
    cameras = heldout_cameras(len(frames), scene.camera.width, scene.camera.height)
    for name, camera in cameras.items():
        _write_heldout(scene, recorded, camera, frames, truth / "heldout" / name)
    _write_train(scene, recorded, truth)
    _write_motion(scene, truth)
    meta = _meta(scene) | {"heldout": list(cameras), "heldout_step": every}
    (truth / "meta.json").write_text(json.dumps(meta, indent=1))


def covisibility(
    scene: SyntheticScene, recorded_depth: np.ndarray, camera: CameraTrack, frames: Sequence[int]
) -> np.ndarray:
    """What of a new view the recorded camera has seen: uint8 [n, h, w], values as in the module's docstring.

    `recorded_depth` [t, h, w] (m) is the recorded camera's. A point counts as seen if it lies at most 3 mm behind
    the farthest of the four recorded pixels around it.
    """
    surface = scene.surface(camera, frames)
    covis = np.zeros(surface.depth.shape, np.uint8)
    recorded = [pinhole(scene.camera, t) for t in range(len(scene))]

    def mark(i: int) -> None:
        same = frames[i]
        for t in (same, *(t for t in range(len(scene)) if t != same)):
            mark_covisible(
                scene.geometry[t],
                recorded[t],
                recorded_depth[t],
                surface.primitive[i],
                surface.local[i],
                covis[i],
                2 if t == same else 1,
            )

    deque(in_threads(mark, range(len(frames))), maxlen=0)
    return covis


def _bodies(scene: SyntheticScene, camera: CameraTrack, frames: Sequence[int] | None = None) -> np.ndarray:
    """Body ids [h, w, t] of a view, uint8."""
    ids = np.append(scene.body_of_primitive, 0)[scene.surface(camera, frames).primitive]
    return np.moveaxis(ids.astype(np.uint8), 0, -1)


def _write_heldout(
    scene: SyntheticScene, recorded: SyntheticView, camera: CameraTrack, frames: list[int], path: Path
) -> None:
    """Images and arrays of one held-out camera, at `path` and with its suffixes."""
    images = scene.render(camera, frames).rgb.numpy()
    path.mkdir()
    for frame, image in zip(frames, images, strict=True):
        cv2.imwrite(str(path / f"rgb_{frame:04d}.png"), image[..., ::-1])
    _write_lossless(images, path.with_name(f"{path.name}.mkv"), scene.fps)
    covis = covisibility(scene, recorded.depth.numpy(), camera, frames)
    np.savez_compressed(
        path.with_name(f"{path.name}.npz"),
        frame=np.array(frames),
        c2w=camera.world_from_camera.double().numpy(),
        K=camera.intrinsics[0].double().numpy(),
        seg=_bodies(scene, camera, frames),
        covis=np.moveaxis(covis, 0, -1),
    )


def _write_lossless(images: np.ndarray, path: Path, fps: int) -> None:
    """Images uint8 [n, h, w, 3] as a video that decodes to exactly the same values."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=fps, options={"slices": "4"})
        stream.height, stream.width, stream.pix_fmt = images.shape[1], images.shape[2], "bgr0"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def _write_train(scene: SyntheticScene, recorded: SyntheticView, truth: Path) -> None:
    """True depth and segmentation of the recorded video, and its camera."""
    depth = np.rint(recorded.depth.numpy() / DEPTH_UNIT).astype(np.uint16)
    np.savez_compressed(
        truth / "train.npz",
        depth=np.moveaxis(depth, 0, -1),
        seg=_bodies(scene, scene.camera),
        K=scene.camera.intrinsics[0].double().numpy(),
        c2w=scene.camera.world_from_camera.double().numpy(),
    )


def _write_motion(scene: SyntheticScene, truth: Path) -> None:
    """Robot values, body poses, the sheet's mesh and point tracks."""
    np.savez_compressed(truth / "robot.npz", state=scene.state.numpy(), action=scene.action.numpy())
    poses = scene.world_from_body.transpose(0, 1)
    near = np.stack([geometry.sheet_nodes for geometry in scene.geometry])
    far = near + np.stack([geometry.sheet_across for geometry in scene.geometry])[:, None]
    count = near.shape[1]
    first = np.arange(count - 1)
    faces = np.concatenate(
        [np.stack((first, first + 1, first + count), 1), np.stack((first + 1, first + count + 1, first + count), 1)]
    )
    np.savez_compressed(
        truth / "bodies.npz",
        pose=torch.cat((poses[..., :3, 3], matrix_to_quaternion(poses[..., :3, :3])), dim=-1).numpy(),
        names=np.array(scene.body_names),
        dynamic=_moving_bodies(scene),
        flex_verts=np.concatenate((near, far), axis=1).astype(np.float32),
        flex_faces=faces,
    )
    tracks = scene.tracks(TRACKS)
    np.savez_compressed(
        truth / "tracks.npz",
        xyz=tracks.positions.transpose(0, 1).numpy(),
        uv=tracks.xy.transpose(0, 1).numpy(),
        visible=tracks.visible.T.numpy(),
        body=tracks.body.numpy().astype(np.uint8),
        query_frame=tracks.query.numpy(),
    )


def _moving_bodies(scene: SyntheticScene) -> np.ndarray:
    """Ids of the bodies that belong to moving instances."""
    return np.flatnonzero(scene.instance_of_body.numpy())


def _meta(scene: SyntheticScene) -> dict[str, Any]:
    """What holds for the whole scene."""
    moving = _moving_bodies(scene).tolist()
    return {
        "scene": scene.kind,
        "task": scene.task,
        "seed": scene.seed,
        "episode": scene.episode,
        "frames": len(scene),
        "fps": scene.fps,
        "width": scene.camera.width,
        "height": scene.camera.height,
        "moving_camera": not scene.camera.is_static,
        "K": scene.camera.intrinsics[0].tolist(),
        "depth_unit_m": DEPTH_UNIT,
        "flex_seg_id": scene.body_names.index("sheet"),
        "bodies": {str(i): name for i, name in enumerate(scene.body_names)},
        "dynamic_ids": moving,
        "dynamic_names": [scene.body_names[i] for i in moving],
        "instances": list(scene.instance_names),
        "instance_of_body": scene.instance_of_body.tolist(),
    }
