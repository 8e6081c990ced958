"""Poses of a moving camera that are learned with the Gaussians."""

from dataclasses import replace

import torch
from still_video import grey_scene, still_video
from walking import FRAMES, walk

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import FitConfig, LearningRates, MotionConfig, SceneConfig
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, project, se3, transform_points
from lerobot_msdyn.core.observations import Priors, View
from lerobot_msdyn.reconstruction.fit import FitResult, fit
from lerobot_msdyn.reconstruction.initialise import initialise
from lerobot_msdyn.reconstruction.key_views import key_views
from lerobot_msdyn.reconstruction.learned_poses import LearnedPoses

DISTANCE = 0.7  # m


def off_by(camera: CameraTrack, turn_deg: float, shift_m: float) -> CameraTrack:
    """Poses with noise of these lengths (root mean square)."""
    random = torch.Generator().manual_seed(0)
    turns, shifts = (torch.randn(FRAMES, 3, generator=random) / 3**0.5 for _ in range(2))
    by = se3(axis_angle_to_matrix(torch.deg2rad(torch.tensor(turn_deg)) * turns), shift_m * shifts)
    return replace(camera, world_from_camera=camera.world_from_camera @ by)


def fitted(view: View, priors: Priors, camera: CameraTrack, *, poses: bool, steps: int = 160) -> FitResult:
    """A fit to the video through other poses, of a scene made through the right ones."""
    keys = key_views(view, priors)
    scene = initialise(view, priors, SceneConfig(), MotionConfig(max_parts=1, levels=["object"]), keys)
    config = FitConfig(steps=steps, sh_degree=0, shadows=False, moving_gain_from=1.0, held_out_frames=0)
    config.learn.poses = poses
    seen = replace(view, camera=camera)
    return fit(scene, seen, priors, config, empty=keys[0].empty.rgb, distance=DISTANCE, seed=0)


def error_px(found: CameraTrack, true: CameraTrack) -> float:
    """Mean distance (px) in the picture of some points before the camera from their place."""
    points = torch.tensor([[0.0, 0.0, 0.7], [0.2, 0.1, 0.7], [-0.2, 0.1, 0.8]]).expand(FRAMES, -1, -1)
    world = transform_points(true.world_from_camera, points)
    there, here = (
        project(transform_points(camera.camera_from_world, world), true.intrinsics)[0] for camera in (found, true)
    )
    return float((there - here).norm(dim=-1).mean())


def test_poses_that_are_off_come_back_and_the_pictures_with_them() -> None:
    _, view, priors = walk()
    off = off_by(view.camera, 0.3, 0.003)
    learned, given = (fitted(view, priors, off, poses=poses) for poses in (True, False))
    assert torch.equal(given.camera.world_from_camera, off.world_from_camera)
    assert error_px(learned.camera, view.camera) < 0.5 * error_px(off, view.camera)
    assert learned.train_psnr_db > given.train_psnr_db + 0.5
    assert not learned.camera.world_from_camera.requires_grad


def test_poses_that_are_right_stay() -> None:
    _, view, priors = walk()
    learned, given = (fitted(view, priors, view.camera, poses=poses) for poses in (True, False))
    assert error_px(learned.camera, view.camera) < 0.1
    assert learned.train_psnr_db > given.train_psnr_db - 0.1


def test_a_camera_that_stands_still_has_no_poses_to_learn() -> None:
    view, priors = still_video()
    config = FitConfig(steps=2)
    config.learn.poses = True
    result = fit(grey_scene(view), view, priors, config, empty=view.rgb[0], distance=1.0, seed=0)
    assert result.camera.is_static
    assert torch.equal(result.camera.world_from_camera, view.camera.world_from_camera)


def test_frames_that_are_not_fitted_have_what_lies_between() -> None:
    _, view, _ = walk()
    poses = LearnedPoses(view.camera, torch.tensor([0, 5]), LearningRates(), DISTANCE, torch.device("cpu"))
    turns, shifts = (group["params"][0] for group in poses.groups)
    assert len(turns) == len(shifts) == FRAMES - 2
    with torch.no_grad():
        shifts += 0.01 * torch.arange(1.0, FRAMES).repeat(3, 1).T[torch.arange(FRAMES - 1) != 4]
    assert float(poses.loss().detach()) > 0
    by = view.camera.camera_from_world @ poses.result().world_from_camera
    expected = 0.01 * torch.arange(FRAMES).clamp(min=1)
    torch.testing.assert_close(by[:, :3, 3], expected[:, None].expand(-1, 3), atol=1e-5, rtol=0)
