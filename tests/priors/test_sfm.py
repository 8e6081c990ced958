"""Poses of a moving camera."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, se3
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.priors.camera import sfm
from lerobot_msdyn.priors.camera.sfm import camera_from_sfm, interpolated_poses
from lerobot_msdyn.synthetic import make_scene

FRAMES = 16


@pytest.fixture(scope="module")
def moving() -> tuple[View, torch.Tensor]:
    """A camera that travels to the side while it turns, and the masks of what moves."""
    scene = make_scene("push", 0, FRAMES, 320, 240)
    share = torch.linspace(0, 1, FRAMES, dtype=torch.float64)
    turns = axis_angle_to_matrix(torch.stack((0 * share, -0.3 * share, 0 * share), dim=1))
    shifts = torch.stack((0.25 * share, 0.02 * share, 0 * share), dim=1)
    poses = scene.camera.world_from_camera.double() @ se3(turns, shifts)
    camera = CameraTrack(scene.camera.intrinsics, poses.float(), 320, 240)
    seen = scene.render(camera)
    return View(seen.rgb, camera), seen.instances


def test_poses_are_in_a_frame_of_their_own(moving, monkeypatch: pytest.MonkeyPatch) -> None:
    view, instances = moving
    view = replace(view, camera=replace(view.camera, world="calibration"))
    poses = {frame: pose.double().numpy() for frame, pose in enumerate(view.camera.world_from_camera)}
    model = poses, view.camera.intrinsics[0].double().numpy()
    monkeypatch.setattr(sfm, "demand_library", lambda *_: None)
    monkeypatch.setattr(sfm, "_reconstruct", lambda *_: model)
    found = camera_from_sfm(view, instances)
    assert not found.is_static
    assert found.world == ""


@pytest.mark.slow
def test_a_moving_camera_is_found(moving) -> None:
    pytest.importorskip("pycolmap")
    view, instances = moving
    found = camera_from_sfm(view, instances)
    assert len(found) == FRAMES
    assert found.origin == "sfm"
    torch.testing.assert_close(found.world_from_camera[0], torch.eye(4), atol=1e-5, rtol=0)
    truth = torch.linalg.inv(view.camera.world_from_camera[:1].double()) @ view.camera.world_from_camera.double()
    scale = truth[-1, :3, 3].norm() / found.world_from_camera[-1, :3, 3].norm()
    error = (scale * found.world_from_camera[:, :3, 3].double() - truth[:, :3, 3]).norm(dim=-1)
    assert error.max() < 0.02  # m, of 0.25
    turn = found.world_from_camera[:, :3, :3].double().transpose(1, 2) @ truth[:, :3, :3]
    angle = torch.rad2deg(torch.acos(((turn.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).clamp(-1, 1)))
    assert angle.max() < 1.5


def test_a_fixed_camera_is_refused(sliding) -> None:
    pytest.importorskip("pycolmap")
    camera = make_scene("push", 0, len(sliding.rgb), 96, 72).camera
    with pytest.raises(PriorError, match="the camera does not move"):
        camera_from_sfm(View(sliding.rgb, camera), sliding.mask.to(torch.uint8))


def test_without_pycolmap_the_extra_is_named(moving, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(PriorError, match=r"needs pycolmap; install it with: pip install 'lerobot_msdyn\[sfm\]'"):
        camera_from_sfm(*moving)


def test_frames_between_known_ones_are_interpolated() -> None:
    turn = axis_angle_to_matrix(torch.tensor([0.0, 0.4, 0.0], dtype=torch.float64))
    last = se3(turn, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)).numpy()
    poses = interpolated_poses({1: np.eye(4), 5: last}, 8)
    torch.testing.assert_close(poses[0], torch.eye(4))
    half = axis_angle_to_matrix(torch.tensor([0.0, 0.2, 0.0]))
    torch.testing.assert_close(poses[3, :3, :3], half, atol=1e-4, rtol=0)
    torch.testing.assert_close(poses[3, :3, 3], torch.tensor([0.5, 0, 0]))
    torch.testing.assert_close(poses[7], torch.from_numpy(last).float())
