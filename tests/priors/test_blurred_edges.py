"""Blurred depth edges become sharp; slopes, sharp edges and unknown depth stay."""

import cv2
import numpy as np
import torch

from lerobot_msdyn.priors.depth.blurred_edges import sharpened


def step() -> np.ndarray:
    depth = np.full((30, 40), 2.0, np.float32)
    depth[8:22, 12:28] = 1.0
    return depth


def test_a_blurred_edge_is_put_on_either_side() -> None:
    blurred = 1 / cv2.blur(1 / step(), (3, 3))
    found = sharpened(torch.from_numpy(blurred)[None])[0].numpy()
    off = np.minimum(abs(found - 1), abs(found - 2))
    assert np.minimum(abs(blurred - 1), abs(blurred - 2)).max() > 0.3
    assert off.max() < 1e-3
    assert abs(found - step())[10:20, 14:26].max() < 1e-3


def test_sharp_edges_and_slopes_stay() -> None:
    slope = 1 / np.linspace(0.3, 1.0, 40, dtype=np.float32)[None].repeat(30, 0)
    for depth in (step(), slope):
        tensor = torch.from_numpy(depth)[None]
        torch.testing.assert_close(sharpened(tensor), tensor)


def test_unknown_depth_stays_unknown() -> None:
    depth = step()
    depth[:, 11] = 0
    found = sharpened(torch.from_numpy(depth)[None])[0]
    assert (found[:, 11] == 0).all()
    assert (found[found > 0] >= 0.999).all()
    assert (sharpened(torch.zeros(2, 5, 5)) == 0).all()
