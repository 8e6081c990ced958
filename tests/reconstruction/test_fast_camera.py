"""How fast a camera's picture goes, and what that costs it."""

import cv2
import numpy as np
import pytest
import torch

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov, static_camera
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, se3
from lerobot_msdyn.reconstruction.fast_camera import READOUT, fast_sharpness, skew_px, speed_px

WIDTH, HEIGHT, FRAMES = 160, 120, 16
INTRINSICS = intrinsics_from_fov(WIDTH, HEIGHT, 20.0)  # narrow: the picture goes alike everywhere


def panned(degrees: torch.Tensor) -> CameraTrack:
    """A camera that is turned about the vertical, by so much at each frame."""
    turns = torch.deg2rad(degrees)[:, None] * torch.tensor([0.0, 1.0, 0.0])
    poses = se3(axis_angle_to_matrix(turns), torch.zeros(len(degrees), 3))
    return CameraTrack(INTRINSICS.expand(len(degrees), 3, 3).contiguous(), poses, WIDTH, HEIGHT)


def test_the_speed_is_that_of_the_picture_at_320_px() -> None:
    camera = panned(0.5 * torch.arange(FRAMES))
    expected = 2 * float(INTRINSICS[0, 0]) * np.deg2rad(0.5)
    speed = speed_px(camera, 1.0)
    assert speed.tolist() == pytest.approx([expected] * FRAMES, rel=0.03)
    assert speed_px(camera, 5.0).tolist() == pytest.approx(speed.tolist(), rel=1e-3), "it does not go anywhere"
    assert skew_px(speed) == pytest.approx(READOUT * expected, rel=0.03)


def test_a_shift_counts_by_distance() -> None:
    places = 0.01 * torch.arange(FRAMES)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    poses = se3(torch.eye(3).expand(FRAMES, 3, 3), places)
    camera = CameraTrack(INTRINSICS.expand(FRAMES, 3, 3).contiguous(), poses, WIDTH, HEIGHT)
    for distance in (0.5, 2.0):
        expected = 2 * float(INTRINSICS[0, 0]) * 0.01 / distance
        assert speed_px(camera, distance).tolist() == pytest.approx([expected] * FRAMES, rel=1e-3)


def test_a_camera_that_stands_still_costs_nothing() -> None:
    speed = speed_px(static_camera(INTRINSICS, FRAMES, WIDTH, HEIGHT), 1.0)
    assert skew_px(speed) == 0
    assert fast_sharpness(noise(), speed) == 1


def noise() -> torch.Tensor:
    random = np.random.default_rng(0)
    return torch.from_numpy(random.integers(0, 255, (FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8))


def test_blur_shows_where_the_camera_goes_fast() -> None:
    speed = torch.cat((torch.full((8,), 1.0), torch.full((8,), 9.0)))
    pictures = noise()
    assert fast_sharpness(pictures, speed) == pytest.approx(1, abs=0.1)
    pictures[8:] = torch.stack([torch.from_numpy(cv2.blur(picture.numpy(), (9, 1))) for picture in pictures[8:]])
    assert fast_sharpness(pictures, speed) < 0.3
    assert fast_sharpness(pictures, speed.clamp(max=2.0)) == 1, "too even a speed tells nothing"
