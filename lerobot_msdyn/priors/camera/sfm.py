"""Poses of a moving camera by structure from motion (COLMAP through pycolmap), the moving things left out."""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.core.geometry import matrix_to_quaternion, quaternion_to_matrix
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.sampling import evenly, scaled_px
from lerobot_msdyn.priors.camera.steadiness import FIXED_PX, camera_motion_px
from lerobot_msdyn.priors.hub import demand_library
from lerobot_msdyn.priors.registry import Unusable

SFM = "sfm"  # the name of the provider, and of the origin of its cameras
_MAX_FRAMES = 100  # that are registered; the others are interpolated
_OVERLAP = 10  # neighbours of a frame with which it is matched
_MIN_SHARE = 0.5  # of the registered frames


def camera_from_sfm(view: View, instances: UInt8[Tensor, "t h w"]) -> CameraTrack:
    """The camera at every frame; the first one's frame is the world's, and the unit of length is arbitrary.

    The focal length is that of `view.camera`, refined where it is only assumed. Frames between
    registered ones are interpolated.

    Raises:
        PriorError: pycolmap is absent, or the camera does not move.
        EpisodeError: too few frames of this video could be registered.
    """
    demand_library("pycolmap", "sfm", "structure from motion")
    motion = camera_motion_px(view.rgb, instances > 0) / scaled_px(1, view.camera.width)
    if motion < FIXED_PX:
        raise Unusable(
            f"the camera does not move ({motion:.2f} px): there is no parallax to reconstruct from",
            "use --camera.poses auto",
        )
    frames = evenly(len(view), _MAX_FRAMES).numpy()
    with tempfile.TemporaryDirectory(prefix="lerobot_msdyn_sfm_") as name:
        folder = Path(name)
        _write_images(folder, view, instances, frames)
        model = _reconstruct(folder, view.camera)
    poses, intrinsics = model if model is not None else ({}, None)
    if intrinsics is None or len(poses) < max(2, _MIN_SHARE * len(frames)):
        raise EpisodeError(
            f"structure from motion registered {len(poses)} of {len(frames)} frames; expected half of them or more: "
            "too little texture or parallax; give the poses by --camera.poses FILE.npz"
        )
    world_from_camera = interpolated_poses(poses, len(view.rgb))
    return replace(
        view.camera,
        intrinsics=torch.from_numpy(intrinsics).float().expand(len(view.rgb), 3, 3).contiguous(),
        world_from_camera=world_from_camera,
        origin=SFM,
        world="",
    )


def _write_images(folder: Path, view: View, instances: UInt8[Tensor, "t h w"], frames: ndarray) -> None:
    """images/000123.png, and masks/000123.png.png: COLMAP ignores features where a mask is 0."""
    for kind in ("images", "masks"):
        (folder / kind).mkdir()
    for frame in frames.tolist():
        picture = cv2.cvtColor(view.rgb[frame].numpy(), cv2.COLOR_RGB2BGR)
        grown = cv2.dilate((instances[frame] > 0).numpy().astype(np.uint8), np.ones((7, 7), np.uint8))
        cv2.imwrite(str(folder / "images" / f"{frame:06d}.png"), picture)
        cv2.imwrite(str(folder / "masks" / f"{frame:06d}.png.png"), np.where(grown > 0, 0, 255).astype(np.uint8))


def _reconstruct(
    folder: Path, camera: CameraTrack
) -> tuple[dict[int, Float[ndarray, "4 4"]], Float[ndarray, "3 3"]] | None:
    """World-from-camera of the registered frames of the largest model, and the refined intrinsics."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    k = camera.intrinsics[0]
    parameters = ",".join(str(float(value)) for value in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
    database = folder / "database.db"
    # One thread and fixed seeds, so that the same video gives the same poses every time.
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1)
    matching, verification = pycolmap.FeatureMatchingOptions(num_threads=1), pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed, verification.ransac.num_threads = 0, 1
    mapping = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0)
    mapping.ba_refine_focal_length = camera.origin == "assumed"
    pycolmap.extract_features(
        database,
        folder / "images",
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=pycolmap.ImageReaderOptions(
            camera_model="PINHOLE", camera_params=parameters, mask_path=folder / "masks"
        ),
        extraction_options=extraction,
    )
    pycolmap.match_sequential(
        database,
        matching_options=matching,
        pairing_options=pycolmap.SequentialPairingOptions(overlap=_OVERLAP),
        verification_options=verification,
    )
    models: dict[int, Any] = pycolmap.incremental_mapping(database, folder / "images", folder, mapping)
    if not models:
        return None
    model = max(models.values(), key=lambda item: item.num_reg_images())
    poses = {}
    for image in model.images.values():
        if image.has_pose:
            matrix = np.eye(4)
            matrix[:3] = image.cam_from_world().inverse().matrix()
            poses[int(Path(image.name).stem)] = matrix
    return poses, next(iter(model.cameras.values())).calibration_matrix()


def interpolated_poses(poses: dict[int, Float[ndarray, "4 4"]], frames: int) -> Float[Tensor, "t 4 4"]:
    """World-from-camera at every frame, from some: linear positions, turns along the shortest way; ends are held.

    The first frame's camera becomes the world.
    """
    registered = sorted(poses)
    matrices = torch.from_numpy(np.stack([poses[frame] for frame in registered])).double()
    quats = matrix_to_quaternion(matrices[:, :3, :3])
    for i in range(1, len(quats)):
        if float((quats[i] * quats[i - 1]).sum()) < 0:
            quats[i] = -quats[i]
    values = torch.cat((quats, matrices[:, :3, 3]), dim=1).numpy()
    every = np.stack([np.interp(np.arange(frames), registered, values[:, i]) for i in range(7)], axis=1)
    out = torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1)
    turns = torch.from_numpy(every[:, :4] / np.linalg.norm(every[:, :4], axis=1, keepdims=True))
    out[:, :3, :3] = quaternion_to_matrix(turns)
    out[:, :3, 3] = torch.from_numpy(every[:, 4:])
    return (torch.linalg.inv(out[:1]) @ out).float()
