"""Poses of a moving camera are refined by what stands still."""

from dataclasses import replace

import torch
from walking import FRAMES, walk

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, project, se3, transform_points
from lerobot_msdyn.reconstruction.align_poses import aligned_poses
from lerobot_msdyn.reconstruction.key_views import key_views

DISTANCE = 0.7  # m
SEEN = torch.tensor([[0.0, 0.0, 0.7], [0.2, 0.1, 0.7], [-0.2, 0.1, 0.8]])  # m, before the camera


def error_px(found: CameraTrack, true: CameraTrack) -> float:
    """Median distance (px) in the picture of some points from their place, beyond what all frames have in common."""
    points = transform_points(true.world_from_camera, SEEN.expand(FRAMES, -1, -1))
    there, here = (
        project(transform_points(camera.camera_from_world, points), true.intrinsics)[0] for camera in (found, true)
    )
    away = there - here
    return float((away - away.median(0).values).norm(dim=-1).median())


def test_poses_that_are_off_are_brought_back() -> None:
    _, view, priors = walk()
    random = torch.Generator().manual_seed(0)
    turns = axis_angle_to_matrix(0.004 * torch.randn(FRAMES, 3, generator=random))
    shifts = 0.003 * torch.randn(FRAMES, 3, generator=random)
    off = replace(view.camera, world_from_camera=view.camera.world_from_camera @ se3(turns, shifts))
    blurred = replace(view, camera=off)
    found = aligned_poses(key_views(blurred, priors), blurred, priors, DISTANCE)
    assert error_px(off, view.camera) > 0.4
    assert error_px(found, view.camera) < 0.15


def test_poses_that_are_right_stay() -> None:
    _, view, priors = walk()
    found = aligned_poses(key_views(view, priors), view, priors, DISTANCE)
    assert error_px(found, view.camera) < 0.05


def test_a_frame_that_shows_nothing_keeps_its_pose() -> None:
    _, view, priors = walk()
    rgb = view.rgb.clone()
    rgb[3] = 0
    found = aligned_poses(key_views(view, priors), replace(view, rgb=rgb), priors, DISTANCE)
    moved = (found.world_from_camera[3, :3, 3] - view.camera.world_from_camera[3, :3, 3]).norm()
    assert moved < 0.02 * DISTANCE
