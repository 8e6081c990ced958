"""Depth from matched features."""

import numpy as np
import pytest
import torch
from rig import moved

from lerobot_msdyn.priors.depth.triangulate import confirmed, find_features, matched_points, spread, without_outliers
from lerobot_msdyn.synthetic import make_scene


def test_matched_features_lie_on_the_scene() -> None:
    scene = make_scene("push", 0, 2, 320, 240)
    camera = moved(scene.camera, (0, 0, 0)).select([0])
    other = moved(scene.camera, (0.15, 0, 0), -10.0).select([0])
    seen, seen_other = scene.render(camera, [0]), scene.render(other, [0])
    darker = (0.6 * seen_other.rgb[0].numpy()).astype(np.uint8)  # another exposure
    points = matched_points(find_features(seen.rgb[0].numpy()), find_features(darker), camera, other)
    assert len(points) > 30
    truth = seen.depth[0].numpy()[points[:, 1].astype(int), points[:, 0].astype(int)]
    error = np.abs(points[:, 2] / truth - 1)
    assert np.median(error) < 0.02
    assert (error > 0.2).mean() < 0.1


def test_pictures_without_features_give_no_points() -> None:
    flat = find_features(np.full((48, 64, 3), 90, np.uint8))
    camera = make_scene("push", 0, 2, 64, 48).camera
    assert matched_points(flat, flat, camera, camera).shape == (0, 3)


def test_sparse_points_are_spread_smoothly() -> None:
    generator = np.random.default_rng(0)
    xy = generator.uniform(0, (96, 72), (150, 2))
    inverse = 0.5 + xy[:, 0] / 96  # a slanted plane has an inverse depth that is linear in the image
    points = np.c_[xy, 1 / inverse].astype(np.float32)
    inside = np.ones((72, 96), bool)
    inside[:10, :10] = False
    dense = spread(points, inside)
    assert (dense[:10, :10] == 0).all()
    truth = 1 / (0.5 + (np.arange(96) + 0.5) / 96)
    error = np.abs(dense / truth - 1)[inside]
    assert np.median(error) < 0.03
    assert error.max() < 0.3


def test_nothing_to_spread() -> None:
    assert (spread(np.zeros((0, 3), np.float32), np.ones((8, 8), bool)) == 0).all()


def test_only_what_several_frames_agree_on_is_background() -> None:
    there = np.array([[20, 20, 2.0]], np.float32)
    chance = [np.array([[60, 40, z]], np.float32) for z in (0.3, 1.0, 3.0, 0.5)]
    found = confirmed([np.concatenate((there, wrong)) for wrong in chance])
    np.testing.assert_array_equal(found, np.repeat(there, 4, axis=0))
    assert confirmed([np.zeros((0, 3), np.float32)]).shape == (0, 3)


def test_outliers_of_a_thing_are_left_out() -> None:
    z = np.r_[np.linspace(0.95, 1.05, 20), 0.2, 5.0]
    points = np.c_[np.zeros((22, 2)), z].astype(np.float32)
    assert len(without_outliers(points)) == 20


@pytest.mark.parametrize("count", [0, 1])
def test_hardly_any_points(count: int) -> None:
    points = torch.rand(count, 3).numpy() + 1
    assert len(without_outliers(points)) == count
