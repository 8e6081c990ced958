"""What moves before a camera that moves itself."""

import cv2
import numpy as np
import torch

from lerobot_msdyn.priors.masks.moving import moving_instances, temporal_median
from lerobot_msdyn.priors.masks.wandering import residual_odds

FRAMES, WIDTH, HEIGHT, PAN = 30, 120, 90, 4


def panned(square: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """A camera that pans over a textured wall by 4 px a frame, before which a red square crosses; and where it is."""
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.integers(60, 200, (24, 64, 3), dtype=np.uint8), (320, 120), interpolation=cv2.INTER_CUBIC)
    frames, truth = [], np.zeros((FRAMES, HEIGHT, WIDTH), bool)
    for t in range(FRAMES):
        frame = wall[10 : 10 + HEIGHT, PAN * t : PAN * t + WIDTH].copy()
        if square:
            truth[t, 30:50, 10 + 3 * t - 10 : 30 + 3 * t - 10] = True
            frame[truth[t]] = (220, 20, 20)
        frames.append(frame)
    return np.stack(frames), truth


def test_the_square_is_found_and_the_wall_is_not() -> None:
    frames, truth = panned()
    rgb = torch.from_numpy(frames)
    found = moving_instances(rgb, *temporal_median(rgb)).numpy() > 0
    middle = slice(6, -6)
    iou = (found & truth)[middle].sum() / (found | truth)[middle].sum()
    assert iou > 0.7


def test_without_anything_that_moves_nothing_does() -> None:
    frames, _ = panned(square=False)
    assert (residual_odds(frames) > 0).mean() < 0.01


def test_frames_without_neighbours_or_corners_are_not_judged() -> None:
    frames, _ = panned()
    assert (residual_odds(frames[:3]) == 0).all()
    assert (residual_odds(np.zeros((20, 60, 80, 3), np.uint8)) == 0).all()
