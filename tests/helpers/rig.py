"""Calibrated cameras beside each other."""

import numpy as np
import torch

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, se3


def moved(camera: CameraTrack, shift: tuple[float, float, float], turn_deg: float = 0.0) -> CameraTrack:
    """The camera, calibrated, shifted in its own axes (m) and turned about its vertical."""
    turn = axis_angle_to_matrix(torch.tensor([0.0, np.radians(turn_deg), 0.0], dtype=torch.float64))
    pose = camera.world_from_camera.double() @ se3(turn, torch.tensor(shift, dtype=torch.float64))
    return CameraTrack(camera.intrinsics, pose.float(), camera.width, camera.height, "calibration")
