"""Sway of a camera."""

import cv2
import numpy as np
import torch

from lerobot_msdyn.priors.masks.moving import moving_instances, temporal_median
from lerobot_msdyn.priors.masks.stabilise import camera_sway, to_frames, to_reference


def swaying(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Images shifted by up to 1.5 px to and fro, and the shifts [t,2]."""
    phase = np.arange(len(images)) * 0.9
    shift = 1.5 * np.stack((np.sin(phase), np.cos(1.3 * phase)), axis=1)
    moved = [
        cv2.warpAffine(image, np.array([[1, 0, x], [0, 1, y]], np.float32), (96, 72), borderMode=cv2.BORDER_REPLICATE)
        for image, (x, y) in zip(images, shift, strict=True)
    ]
    return np.stack(moved), shift


def test_sway_is_found_in_spite_of_a_moving_block(sliding) -> None:
    frames, shift = swaying(sliding.rgb.numpy())
    sway = camera_sway(frames, sliding.empty.round().astype(np.uint8))
    assert sway is not None
    centre = np.array([48, 36, 1], np.float32)
    np.testing.assert_allclose(sway @ centre - centre[:2], shift, atol=0.25)


def test_a_camera_that_stands_still_has_none(sliding) -> None:
    assert camera_sway(sliding.rgb.numpy(), sliding.empty.round().astype(np.uint8)) is None


def test_a_blank_scene_tells_nothing() -> None:
    blank = np.full((4, 72, 96, 3), 90, np.uint8)
    assert camera_sway(blank, blank[0]) is None


def test_there_and_back() -> None:
    masks = np.zeros((1, 72, 96), np.uint8)
    masks[0, 20:40, 30:50] = 1
    sway = np.array([[[1, 0, 3], [0, 1, -2]]], np.float32)
    expected = np.zeros_like(masks)
    expected[0, 18:38, 33:53] = 1
    np.testing.assert_array_equal(to_frames(masks, sway), expected)
    np.testing.assert_array_equal(to_reference(expected, sway), masks)


def test_a_block_is_found_from_a_swaying_camera(sliding) -> None:
    frames, shift = swaying(sliding.rgb.numpy())
    truth, _ = swaying(sliding.mask.numpy().astype(np.uint8))
    rgb = torch.from_numpy(frames)
    instances = moving_instances(rgb, *temporal_median(rgb)).numpy()
    for frame in (2, 12, 27):
        found, true = instances[frame] > 0, truth[frame] > 0
        assert (found & true).sum() / (found | true).sum() > 0.65, (frame, shift[frame])
