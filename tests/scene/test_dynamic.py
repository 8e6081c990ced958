"""Scenes: what they hold at a time."""

import dataclasses

import torch

from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import with_slope


def test_static_stays_and_moving_follows_its_part(scene_with_two_parts: DynamicScene) -> None:
    scene = scene_with_two_parts
    snapshot = scene.at(torch.tensor([0, 1, 2]))
    still, moving = snapshot.means[:, :2], snapshot.means[:, 2:]
    torch.testing.assert_close(still, scene.static.means.expand(3, -1, -1))
    torch.testing.assert_close(moving[:, 0], scene.moving.means[0].expand(3, -1))
    torch.testing.assert_close(moving[0], scene.moving.means)
    torch.testing.assert_close(moving[1, 1:], scene.moving.means[1:] + torch.tensor([1.0, 0, 0]))
    x, y, z = scene.moving.means[1:].unbind(-1)
    torch.testing.assert_close(moving[2, 1:], torch.stack((-y, x, z), dim=-1), atol=1e-6, rtol=0)
    assert snapshot.moving.tolist() == [0, 0, 1, 1, 1]


def test_colours_of_what_moves_depend_on_the_side_from_which_it_is_seen(scene_with_two_parts: DynamicScene) -> None:
    scene = scene_with_two_parts
    sloped = with_slope(scene.moving)
    sloped.means[:] = 0
    sloped.sh[:, 0] = 0
    sloped.sh[:, 3] = -1  # brighter the more one looks along the canonical x
    scene = dataclasses.replace(scene, moving=sloped)
    along_x = scene.at(torch.tensor([0, 2]), torch.tensor([[-5.0, 0, 0]] * 2)).rgb[:, 2:, 0]
    # At frame 2 the second part has turned a quarter about z: one looks along its own -y.
    expected = torch.tensor([[0.5 + 0.4886025] * 3, [0.5 + 0.4886025, 0.5, 0.5]])
    torch.testing.assert_close(along_x, expected)
    from_nowhere = scene.at(torch.tensor([0, 2])).rgb[:, 2:]
    torch.testing.assert_close(from_nowhere, torch.full_like(from_nowhere, 0.5))
