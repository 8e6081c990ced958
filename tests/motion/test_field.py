"""The deformation field: it learns a motion, moves nothing before, and is repeatable."""

import torch

from lerobot_msdyn.motion.field import fit_field


def bent() -> tuple[torch.Tensor, torch.Tensor]:
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    time = torch.linspace(0, 1, 10)[:, None]
    return points, points[:, None] + 0.2 * time * torch.tensor([1.0, 0.0, 0.0]) * points[:, None, 1:2]


def test_it_learns_a_motion() -> None:
    points, xyz = bent()
    field = fit_field(points, xyz, torch.ones(200, 10), steps=300)
    nothing = torch.zeros(200, 0, dtype=torch.long)
    moved, _ = field.carry(
        points.expand(10, -1, -1), torch.ones(10, 200, 4), nothing, nothing.float(), torch.arange(10)
    )
    assert (moved.transpose(0, 1) - xyz).norm(dim=-1).mean() < 0.01
    again = fit_field(points, xyz, torch.ones(200, 10), steps=300)
    assert torch.equal(field.last, again.last)


def test_without_observations_nothing_moves() -> None:
    points, xyz = bent()
    field = fit_field(points, xyz, torch.zeros(200, 10), steps=5)
    nothing = torch.zeros(200, 0, dtype=torch.long)
    still = torch.nn.functional.normalize(torch.ones(1, 200, 4), dim=-1)
    moved, turned = field.carry(points[None], still, nothing, nothing.float(), torch.tensor([3.0]))
    torch.testing.assert_close(moved[0], points)
    torch.testing.assert_close(turned, still)
