"""Small scenes."""

import pytest
import torch

from lerobot_msdyn.core.geometry import axis_angle_to_matrix, se3
from lerobot_msdyn.motion.model.bases import level_from_motions
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import Gaussians, gaussians_from_points


def some_gaussians(count: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    return gaussians_from_points(
        torch.randn(count, 3, generator=generator),
        torch.randn(count, 4, generator=generator),
        torch.rand(count, 3, generator=generator) + 0.1,
        torch.rand(count, 3, generator=generator),
        0.7,
    )


@pytest.fixture
def scene_with_two_parts() -> DynamicScene:
    """The second part shifts by 1 m along x at frame 1 and turns a quarter about z at frame 2."""
    motions = torch.eye(4).repeat(2, 3, 1, 1)
    motions[1, 1, 0, 3] = 1.0
    motions[1, 2] = se3(axis_angle_to_matrix(torch.tensor([0.0, 0.0, torch.pi / 2])), torch.zeros(3))
    level = level_from_motions(motions, torch.zeros(2, 3))
    part = torch.tensor([0, 1, 1])
    return DynamicScene(
        some_gaussians(2), some_gaussians(3, 1), (level,), (part[:, None],), (torch.zeros(3, 1),), frames=3
    )


@pytest.fixture
def gaussians() -> Gaussians:
    """Five of them."""
    return some_gaussians(5)
