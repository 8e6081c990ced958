"""Cameras of a synthetic scene: the recorded ones and the held-out ones around the front camera."""

import math

import numpy as np
import torch

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov, static_camera
from lerobot_msdyn.synthetic.rigid import look_at

TARGET = np.array([0.0, 0.03, 0.04])  # m, what the front camera looks at and the held-out ones orbit about
DISTANCE, ELEVATION, FOV = 0.70, 32.0, 55.0  # m, degrees, degrees (horizontal)


def _orbit(azimuth: float, elevation: float, distance: float = DISTANCE) -> np.ndarray:
    """Pose [4, 4] that looks at TARGET from an azimuth (degrees, positive to the right) and elevation."""
    a, e = math.radians(azimuth), math.radians(elevation)
    eye = TARGET + distance * np.array([math.cos(e) * math.sin(a), -math.cos(e) * math.cos(a), math.sin(e)])
    return look_at(eye, TARGET)


def _beside(metres: float) -> np.ndarray:
    """The front pose moved along its own x axis without turning."""
    out = _orbit(0.0, ELEVATION)
    out[:3, 3] += metres * out[:3, 0]
    return out


HELDOUT = {
    "az-10": _orbit(-10.0, ELEVATION),
    "az-05": _orbit(-5.0, ELEVATION),
    "az+05": _orbit(5.0, ELEVATION),
    "az+10": _orbit(10.0, ELEVATION),
    "el-08": _orbit(0.0, ELEVATION - 8),
    "el+08": _orbit(0.0, ELEVATION + 8),
    "tx-05": _beside(-0.05),
    "tx+05": _beside(0.05),
    "dolly": _orbit(0.0, ELEVATION, 0.88 * DISTANCE),
}


def _fixed(world_from_camera: np.ndarray, frames: int, width: int, height: int) -> CameraTrack:
    intrinsics = intrinsics_from_fov(width, height, FOV)
    return static_camera(intrinsics, frames, width, height, torch.from_numpy(world_from_camera).float())


def recorded_cameras(world_from_gripper: np.ndarray, width: int, height: int) -> dict[str, CameraTrack]:
    """The front and side cameras on their stands and a wrist camera on the gripper ([t, 4, 4])."""
    frames = len(world_from_gripper)
    gripper_from_wrist = look_at(np.array([0.0, -0.11, 0.11]), np.array([0.0, 0.02, 0.01]))
    wrist = torch.from_numpy(world_from_gripper @ gripper_from_wrist).float()
    intrinsics = intrinsics_from_fov(width, height, 70.0).expand(frames, 3, 3).contiguous()
    return {
        "front": _fixed(_orbit(0.0, ELEVATION), frames, width, height),
        "side": _fixed(_orbit(42.0, 30.0), frames, width, height),
        "wrist": CameraTrack(intrinsics, wrist, width, height),
    }


def hand_held_camera(frames: int, width: int, height: int, sway_deg: float = 4.0) -> CameraTrack:
    """A camera that goes to and fro about the front camera's place, up to `sway_deg` of azimuth, half of elevation."""
    phase = np.linspace(0, 2 * math.pi, frames)
    poses = [
        _orbit(sway_deg * math.sin(angle), ELEVATION + 0.5 * sway_deg * math.sin(2 * angle), DISTANCE)
        for angle in phase.tolist()
    ]
    intrinsics = intrinsics_from_fov(width, height, FOV).expand(frames, 3, 3).contiguous()
    return CameraTrack(intrinsics, torch.from_numpy(np.stack(poses)).float(), width, height)


def walking_camera(
    frames: int, width: int, height: int, azimuth_deg: tuple[float, float], world: str = ""
) -> CameraTrack:
    """A camera that goes along an arc from one azimuth to another, up and down by 3 degrees on its way."""
    way = np.linspace(0, 1, frames)
    poses = [
        _orbit(azimuth_deg[0] + (azimuth_deg[1] - azimuth_deg[0]) * t, ELEVATION + 3 * math.sin(2 * math.pi * t))
        for t in way.tolist()
    ]
    intrinsics = intrinsics_from_fov(width, height, FOV).expand(frames, 3, 3).contiguous()
    return CameraTrack(intrinsics, torch.from_numpy(np.stack(poses)).float(), width, height, world=world)


def heldout_cameras(frames: int, width: int, height: int) -> dict[str, CameraTrack]:
    """The front camera moved by 5 and 10 degrees of azimuth, 8 of elevation, 5 cm sideways and 12 % closer."""
    return {name: _fixed(pose, frames, width, height) for name, pose in HELDOUT.items()}
