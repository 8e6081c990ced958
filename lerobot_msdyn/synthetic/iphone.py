"""A scene as a sequence in the layouts of DyCheck's iPhone data and of Shape of Motion's package, in one folder.

docs/evaluate.md names the files. Camera 0 is held in the hand, cameras 1 and 2 stand still. The package's cameras are
in a unit of their own (`UNIT_M`), as structure from motion would give them.
"""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import ConfigError, OutputError
from lerobot_msdyn.core.geometry import matrix_to_quaternion, transform_points, unproject_image
from lerobot_msdyn.synthetic.nvs import covisibility
from lerobot_msdyn.synthetic.rough_depth import rough_depth
from lerobot_msdyn.synthetic.scene import SyntheticScene, SyntheticView
from lerobot_msdyn.synthetic.viewpoints import TARGET, hand_held_camera, heldout_cameras

VALIDATION = ("az+10", "el+08")  # the held-out cameras that become cameras 1, 2, ...
UNIT_M = 0.5  # m per unit of Shape of Motion's cameras
SURE = 8.0  # logit of what is certain
TRACKS = 400
PROCESSED = "flow3d_preprocessed"
PINHOLE = 1  # COLMAP's number of that camera model


def write_iphone_folder(
    scene: SyntheticScene, root: Path, every: int = 5, sway_deg: float = 4.0, *, network_depth: bool = False
) -> None:
    """Writes one sequence by a camera that sways by `sway_deg`; the validation cameras see every `every`-th frame.

    With `network_depth` all depth is as a monocular network would give it (`rough_depth`).

    Raises:
        ConfigError: `every` is not positive, or the size is odd, so that there is no 2x.
        OutputError: `root` exists.
    """
    width, height = scene.camera.width, scene.camera.height
    if every < 1 or width % 2 or height % 2:
        raise ConfigError(f"every must be at least 1 frame and the size even; got {every} and {width}x{height}")
    if root.exists():
        raise OutputError(f"{root} exists already; remove it or choose another folder for the sequence")
    hand_held = hand_held_camera(len(scene), width, height, sway_deg)
    frames = list(range(0, len(scene), every))
    still = heldout_cameras(len(frames), width, height)
    sights = [Sight(0, hand_held, list(range(len(scene))))]
    sights += [Sight(number, still[name], frames) for number, name in enumerate(VALIDATION, start=1)]
    for factor in (1, 2):
        _write_pictures(scene, [sight.smaller(factor) for sight in sights], root, factor, network_depth)
    for sight in sights:
        for i, name in enumerate(sight.names):
            _write_json(root / "camera" / f"{name}.json", _camera(sight.camera, i))
    _write_colmap(root / PROCESSED / "colmap", sights)
    for split, in_split in (("train", sights[:1]), ("val", sights[1:])):
        content = {
            "frame_names": [name for sight in in_split for name in sight.names],
            "time_ids": [frame for sight in in_split for frame in sight.frames],
            "camera_ids": [sight.number for sight in in_split for _ in sight.frames],
        }
        _write_json(root / "splits" / f"{split}.json", content)
    _write_descriptions(scene, sights, root)


@dataclass(frozen=True)
class Sight:
    """One camera of the sequence."""

    number: int
    camera: CameraTrack
    frames: list[int]  # of the scene, that its poses belong to

    @property
    def names(self) -> list[str]:
        """Of its pictures."""
        return [f"{self.number}_{frame:05d}" for frame in self.frames]

    def smaller(self, factor: int) -> "Sight":
        """The same with smaller pictures."""
        camera = self.camera.resized(self.camera.width // factor, self.camera.height // factor)
        return Sight(self.number, camera, self.frames)


def _write_pictures(scene: SyntheticScene, sights: list[Sight], root: Path, factor: int, network_depth: bool) -> None:
    """Pictures, LiDAR-like depth and masks of one size; with those of full size, Shape of Motion's priors as well."""
    size = f"{factor}x"
    scene = replace(scene, cameras={**scene.cameras, "front": sights[0].camera})  # what is seen, is seen by this one
    recorded = scene.render(scene.camera)
    for sight in sights:
        rgb = scene.render(sight.camera, sight.frames).rgb.numpy()
        opaque = np.full((*rgb.shape[:3], 1), 255, np.uint8)
        _write_images(root / "rgb" / size, sight.names, np.concatenate((rgb, opaque), axis=-1))
        if sight.number > 0:
            seen = covisibility(scene, recorded.depth.numpy(), sight.camera, sight.frames) > 0
            package = f"{PROCESSED}/" if factor == 1 else ""
            _write_images(root / f"{package}covisible/{size}/val", sight.names, seen.astype(np.uint8) * 255)
    if network_depth:
        rough = rough_depth(recorded.depth.numpy(), np.random.default_rng(scene.seed))
        recorded = replace(recorded, depth=torch.from_numpy(rough))
    _write_arrays(root / "depth" / size, sights[0].names, recorded.depth.numpy()[..., None])
    if factor == 1:
        _write_priors(scene, recorded, sights[0].names, root / PROCESSED)


def _write_descriptions(scene: SyntheticScene, sights: list[Sight], root: Path) -> None:
    """dataset.json, metadata.json, scene.json and extra.json: which pictures there are, and a box of diagonal 1 (unit).

    This package needs none of them; DyCheck's loader does. Lengths in extra.json, near and far are in that unit.
    """
    train, validation = ([name for sight in some for name in sight.names] for some in (sights[:1], sights[1:]))
    content = {"count": len(train) + len(validation), "num_exemplars": len(train)}
    ids = {"ids": train + validation, "train_ids": train, "val_ids": validation}
    _write_json(root / "dataset.json", content | ids)
    described = {
        name: {"warp_id": frame, "appearance_id": frame, "camera_id": sight.number}
        for sight in sights
        for name, frame in zip(sight.names, sight.frames, strict=True)
    }
    _write_json(root / "metadata.json", described)
    camera = sights[0].camera
    depth = torch.from_numpy(scene.surface(camera).depth)
    seen = torch.stack([unproject_image(z, k).reshape(-1, 3) for z, k in zip(depth, camera.intrinsics, strict=True)])
    away = seen.norm(dim=-1).numpy()
    places = camera.world_from_camera[:, :3, 3]
    points = torch.cat((transform_points(camera.world_from_camera, seen).reshape(-1, 3), places)).double().numpy()
    box = np.stack((points.min(0), points.max(0)))
    center, scale = box.mean(0), float(1 / np.linalg.norm(box[1] - box[0]))
    near, far = 0.75 * scale * np.quantile(away, 0.001), 1.25 * scale * np.quantile(away, 0.999)
    _write_json(
        root / "scene.json", {"scale": scale, "center": center.tolist(), "near": float(near), "far": float(far)}
    )
    up = -camera.world_from_camera[:, :3, 1].double().mean(0).numpy()
    own = {"bbox": ((box - center) * scale).tolist(), "lookat": ((TARGET - center) * scale).tolist(), "up": up.tolist()}
    _write_json(root / "extra.json", {"factor": 2, "fps": scene.fps, **own})


def _write_priors(scene: SyntheticScene, recorded: SyntheticView, names: list[str], folder: Path) -> None:
    """Masks, disparity in the unit of the package's cameras, and a file of tracks for every pair of frames."""
    _write_images(folder / "track_anything" / "1x", names, (recorded.instances.numpy() > 0).astype(np.uint8) * 255)
    disparity = UNIT_M / recorded.depth.numpy().clip(1e-6)
    _write_arrays(folder / "aligned_depth_anything_colmap" / "1x", names, disparity.astype(np.float32))
    tracks = scene.tracks(TRACKS)
    hidden = torch.where(tracks.visible, -SURE, SURE)[..., None]
    files = torch.cat((tracks.xy - 0.5, hidden, torch.full_like(hidden, -SURE)), dim=-1).numpy()
    for query, name in enumerate(names):
        mine = files[tracks.query.numpy() == query]
        _write_arrays(folder / "2d_tracks" / "1x", [f"{name}_{other}" for other in names], mine.swapaxes(0, 1))


def _camera(track: CameraTrack, i: int) -> dict[str, Any]:
    """One pose as DyCheck's files have it."""
    k, pose = track.intrinsics[i].double(), track.world_from_camera[i].double()
    return {
        "orientation": pose[:3, :3].T.tolist(),
        "position": pose[:3, 3].tolist(),
        "focal_length": float(k[0, 0]),
        "principal_point": k[:2, 2].tolist(),
        "skew": 0.0,
        "pixel_aspect_ratio": float(k[1, 1] / k[0, 0]),
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
        "image_size": [track.width, track.height],
    }


def _write_colmap(folder: Path, sights: list[Sight]) -> None:
    """cameras.bin, images.bin and an empty points3D.bin, as COLMAP documents them; a camera per picture."""
    pictures = [(name, sight.camera, i) for sight in sights for i, name in enumerate(sight.names)]
    cameras, images = [struct.pack("<Q", len(pictures))], [struct.pack("<Q", len(pictures))]
    for number, (name, track, i) in enumerate(pictures, start=1):
        k = track.intrinsics[i].double()
        pose = torch.linalg.inv(track.world_from_camera[i].double())
        cameras.append(struct.pack("<iiQQ", number, PINHOLE, track.width, track.height))
        cameras.append(struct.pack("<4d", k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
        quaternion = matrix_to_quaternion(pose[:3, :3]).tolist()
        images.append(struct.pack("<i7di", number, *quaternion, *(pose[:3, 3] / UNIT_M).tolist(), number))
        images.append(f"{name}.png".encode() + b"\0" + struct.pack("<Q", 0))
    sparse = folder / "sparse"
    sparse.mkdir(parents=True)
    for name, content in (("cameras", cameras), ("images", images), ("points3D", [struct.pack("<Q", 0)])):
        (sparse / f"{name}.bin").write_bytes(b"".join(content))
    np.save(folder / "scale.npy", np.array(UNIT_M))


def _write_images(folder: Path, names: Sequence[str], images: np.ndarray) -> None:
    """Grey [n, h, w] or RGBA [n, h, w, 4] pictures as PNG files."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in zip(names, images, strict=True):
        cv2.imwrite(str(folder / f"{name}.png"), image if image.ndim == 2 else image[..., [2, 1, 0, 3]])


def _write_arrays(folder: Path, names: Sequence[str], arrays: np.ndarray) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, array in zip(names, arrays, strict=True):
        np.save(folder / f"{name}.npy", array)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
