"""What the speed of a camera costs its pictures: rows of a rolling shutter that show other moments, and blur."""

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import project, transform_points, unproject
from lerobot_msdyn.core.sampling import REFERENCE_WIDTH

READOUT = 0.5  # share of the time between two frames in which a rolling shutter reads a picture: assumed
FAST = 0.9  # quantile of the speed that stands for a clip's fast frames
FASTEST = 0.25  # share of the frames that are compared for sharpness, at either end
TOLD_PX = 2.0  # px of 320 per frame, by which they must differ in speed for blur to be told
FLAT = 1e-9  # sharpness of a picture without any detail
_GRID = (0.1, 0.5, 0.9)  # of the picture's sides: points whose way is looked at


def speed_px(camera: CameraTrack, distance: float) -> Float[Tensor, " t"]:
    """How far (px of 320) the picture goes at each frame per frame, at a distance (m); 0 of one that stands still."""
    if camera.is_static or len(camera) < 2:
        return torch.zeros(len(camera))
    xy = torch.tensor([[x * camera.width, y * camera.height] for x in _GRID for y in _GRID])
    steps = len(camera) - 1
    points = unproject(xy, torch.full((len(xy),), distance), camera.intrinsics[0]).expand(steps, -1, -1)
    world = transform_points(camera.world_from_camera[:-1], points)
    here, _ = project(points, camera.intrinsics[:-1])
    there, _ = project(transform_points(camera.camera_from_world[1:], world), camera.intrinsics[1:])
    way = (there - here).norm(dim=-1).median(1).values * (REFERENCE_WIDTH / camera.width)
    return torch.maximum(torch.cat((way[:1], way)), torch.cat((way, way[-1:])))


def skew_px(speed: Float[Tensor, " t"]) -> float:
    """How far (px of 320) a rolling shutter displaces the last row against the first, in fast frames."""
    return READOUT * float(speed.quantile(FAST))


def fast_sharpness(rgb: UInt8[Tensor, "t h w 3"], speed: Float[Tensor, " t"]) -> float:
    """Sharpness of the fastest frames relative to that of the slowest; 1 where all are about as fast."""
    few = max(1, round(FASTEST * len(speed)))
    order = speed.argsort()
    slow, fast = order[:few], order[-few:]
    if float(speed[fast].median() - speed[slow].median()) < TOLD_PX:
        return 1.0
    return _usual_sharpness(rgb[fast]) / max(_usual_sharpness(rgb[slow]), FLAT)


def _usual_sharpness(rgb: UInt8[Tensor, "t h w 3"]) -> float:
    return float(np.median([sharpness(picture[None].float() / 255) for picture in rgb]))


def sharpness(pictures: Float[Tensor, "t h w 3"]) -> float:
    """Mean variance of the Laplacian of the brightness (0..1)."""
    grey = (255 * pictures.mean(-1)).numpy()
    return float(np.mean([cv2.Laplacian(image, cv2.CV_32F).var() for image in grey])) / 255**2
