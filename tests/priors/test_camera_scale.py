"""The unit of a moving camera's poses, told by depth."""

from dataclasses import replace

import pytest
import torch
from walking import walk

from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.core.observations import DepthTraits
from lerobot_msdyn.priors.camera.scale import scaled_to_depth
from lerobot_msdyn.priors.registry import Depth


def test_shifts_of_another_unit_become_those_of_the_depth() -> None:
    _, view, priors = walk()
    poses = view.camera.world_from_camera.clone()
    poses[:, :3, 3] /= 3.0
    small = replace(view.camera, world_from_camera=poses)
    found, factor = scaled_to_depth(small, view.rgb, Depth(priors.depth, DepthTraits(metric=True)), priors.instances)
    assert factor == pytest.approx(3.0, rel=0.05)
    torch.testing.assert_close(found.world_from_camera[:, :3, 3], factor * poses[:, :3, 3])


def test_without_depth_nothing_tells() -> None:
    _, view, priors = walk()
    nothing = Depth(torch.zeros_like(priors.depth), DepthTraits())
    with pytest.raises(EpisodeError, match="cannot be told from depth"):
        scaled_to_depth(view.camera, view.rgb, nothing, priors.instances)
