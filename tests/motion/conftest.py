"""Hand-built tracks of rigid bodies."""

import pytest
import torch
from torch import Tensor

from lerobot_msdyn.geometry import axis_angle_to_matrix, se3, transform_points

FRAMES = 24


class Body:
    """Points on a rigid body that turns about an axis through its centre while it shifts; at rest before `start`."""

    def __init__(
        self, seed: int, centre: tuple[float, ...], turn: tuple[float, ...], shift: tuple[float, ...], start: int = 0
    ) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.points = torch.tensor(centre) + 0.05 * (torch.rand(60, 3, generator=generator) - 0.5)
        progress = ((torch.arange(FRAMES) - start).clamp(min=0) / (FRAMES - 1 - start))[:, None]
        rotation = axis_angle_to_matrix(progress * torch.tensor(turn))
        pivot = torch.tensor(centre)
        self.motions = se3(rotation, pivot + progress * torch.tensor(shift) - rotation @ pivot)

    @property
    def xyz(self) -> Tensor:
        """Positions [n,t,3]."""
        return transform_points(self.motions, self.points.expand(FRAMES, -1, -1)).transpose(0, 1).contiguous()

    def relative(self, frame: int) -> Tensor:
        """True motions [t,4,4] from a frame to every frame."""
        return self.motions @ torch.linalg.inv(self.motions[frame])


@pytest.fixture
def tumbling() -> Body:
    return Body(0, (0.1, 0.2, 0.8), (0.4, 0.9, -0.5), (0.15, -0.05, 0.1))


@pytest.fixture
def resting() -> Body:
    return Body(1, (-0.1, 0.0, 0.7), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@pytest.fixture
def late() -> Body:
    return Body(2, (0.3, 0.1, 0.9), (0.0, 0.6, 0.0), (0.0, 0.2, 0.0), start=12)
