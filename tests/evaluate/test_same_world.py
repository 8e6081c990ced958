"""Validation cameras follow where a fit has its world of its own."""

from dataclasses import replace

import torch
from walking import FRAMES, HEIGHT, WIDTH

from lerobot_msdyn.core.geometry import axis_angle_to_matrix, invert_se3, se3
from lerobot_msdyn.evaluate.dycheck.same_world import in_world_of
from lerobot_msdyn.synthetic.viewpoints import hand_held_camera, heldout_cameras


def test_another_world_of_another_unit() -> None:
    given, held_out = hand_held_camera(FRAMES, WIDTH, HEIGHT), heldout_cameras(1, WIDTH, HEIGHT)["az+10"]
    turn, factor = axis_angle_to_matrix(torch.tensor([[0.3, -1.0, 0.2]]))[0], 2.5
    body = se3(turn, torch.tensor([0.1, 2.0, -1.0]))

    def elsewhere(poses: torch.Tensor) -> torch.Tensor:
        moved = body @ poses
        moved[:, :3, 3] *= factor
        return moved

    fitted = replace(given, world_from_camera=elsewhere(given.world_from_camera))
    found = in_world_of(fitted, given, held_out)
    torch.testing.assert_close(found.world_from_camera, elsewhere(held_out.world_from_camera), atol=1e-4, rtol=1e-4)
    assert torch.equal(in_world_of(given, given, held_out).world_from_camera, held_out.world_from_camera)


def test_a_camera_that_stands_still_tells_no_unit() -> None:
    still, held_out = heldout_cameras(FRAMES, WIDTH, HEIGHT)["el+08"], heldout_cameras(1, WIDTH, HEIGHT)["az+10"]
    own = replace(still, world_from_camera=torch.eye(4).expand(FRAMES, 4, 4).contiguous())
    found = in_world_of(own, still, held_out)
    expected = invert_se3(still.world_from_camera[:1]) @ held_out.world_from_camera
    torch.testing.assert_close(found.world_from_camera, expected, atol=1e-5, rtol=1e-4)
