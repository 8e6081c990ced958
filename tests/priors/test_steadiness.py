"""Whether a camera stands still."""

import cv2
import numpy as np
import pytest
import torch
from sliding import texture

from lerobot_msdyn.priors.camera.steadiness import FIXED_PX, SWAY_PX, camera_motion_px


def panned(px_per_frame: float, frames: int = 41) -> torch.Tensor:
    """A camera that pans over a textured wall, with noise."""
    generator = np.random.default_rng(0)
    wall = texture(120, 400, 0, (120, 120, 120))
    out = []
    for t in range(frames):
        shift = np.array([[1, 0, -px_per_frame * t], [0, 1, 0]], np.float32)
        seen = cv2.warpAffine(wall, shift, (160, 120), borderMode=cv2.BORDER_REFLECT)
        out.append(np.clip(seen + generator.normal(size=seen.shape), 0, 255).astype(np.uint8))
    return torch.from_numpy(np.stack(out))


def test_a_fixed_camera_keeps_still_though_things_move(sliding) -> None:
    assert camera_motion_px(sliding.rgb, sliding.mask) < 0.2
    assert camera_motion_px(sliding.rgb) < FIXED_PX


@pytest.mark.parametrize("speed", [0.5, 3.0])
def test_a_pan_is_measured(speed: float) -> None:
    assert camera_motion_px(panned(speed)) == pytest.approx(2 * speed, rel=0.1)  # frames 2 apart are compared


def test_without_corners_phases_decide() -> None:
    blurred = torch.from_numpy(np.stack([cv2.GaussianBlur(frame, (0, 0), 12) for frame in panned(4.0).numpy()]))
    assert camera_motion_px(blurred) > SWAY_PX


def test_a_single_frame_does_not_move() -> None:
    assert camera_motion_px(panned(1.0, 1)) == 0
