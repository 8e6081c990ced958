"""Cameras over time."""

import math
from dataclasses import replace

import pytest
import torch

from lerobot_msdyn.core.cameras import concatenated, intrinsics_from_fov, static_camera
from lerobot_msdyn.core.geometry import project

K = [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]


def test_field_of_view() -> None:
    intrinsics = intrinsics_from_fov(640, 480, 90.0)
    assert float(intrinsics[0, 0]) == pytest.approx(320)
    assert math.degrees(2 * math.atan(320 / float(intrinsics[0, 0]))) == pytest.approx(90)


def test_parts_of_a_track_make_the_track() -> None:
    poses = torch.eye(4).repeat(5, 1, 1)
    poses[:, 0, 3] = torch.arange(5.0)
    track = replace(static_camera(torch.tensor(K), 5, 640, 480), world_from_camera=poses)
    again = concatenated([track.select(slice(0, 2)), track.select(slice(2, 5))])
    assert torch.equal(again.world_from_camera, poses)
    assert (len(again), again.width, again.height) == (5, 640, 480)


def test_static_camera_stands_still() -> None:
    camera = static_camera(torch.tensor(K), 4, 640, 480)
    assert len(camera) == 4
    assert camera.is_static
    assert torch.equal(camera.camera_from_world, torch.eye(4).expand(4, 4, 4))
    assert len(camera.select([1, 3])) == 2


def test_a_cropped_camera_sees_the_same_at_shifted_pixels() -> None:
    camera = static_camera(intrinsics_from_fov(64, 48, 60.0), 2, 64, 48)
    rows, columns = slice(5, 20), slice(12, 50)
    cropped = camera.cropped(rows, columns)
    points = torch.tensor([[0.1, -0.2, 2.0], [-0.4, 0.3, 1.5]])
    whole, part = (project(points, each.intrinsics[1]) for each in (camera, cropped))
    torch.testing.assert_close(part[0], whole[0] - torch.tensor([12.0, 5.0]))
    assert (cropped.width, cropped.height) == (38, 15)
    assert camera.intrinsics[0, 0, 2] == 32, "the camera itself is not changed"
