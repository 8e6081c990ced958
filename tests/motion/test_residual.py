"""Residual motions: robust, pulled to the identity, and guarded where tracks fix no rotation."""

import torch
from torch import Tensor

from lerobot_msdyn.core.geometry import axis_angle_to_matrix
from lerobot_msdyn.motion.finer.residual import (
    ResidualTracks,
    cluster_places,
    pull_back,
    smoothed_level,
    solve_residual,
    whittaker,
)

FRAMES = 5
TURN = axis_angle_to_matrix(torch.tensor([0.0, 0.0, 0.3]))
SHIFT = torch.tensor([0.01, -0.02, 0.005])


def cloud(flat: int = 3, count: int = 40) -> Tensor:
    """Points about (0.2, 0.1, 0.7) that span the first `flat` axes."""
    spread = 0.1 * (torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 0.5)
    spread[:, flat:] = 0
    return torch.tensor([0.2, 0.1, 0.7]) + spread


def solved(points: Tensor, positions: Tensor, noise: float = 1e-6, **options: bool) -> Tensor:
    """The motion [t,4,4] of one basis that all tracks follow."""
    n = len(points)
    nothing = torch.zeros(n, dtype=torch.long)
    tracks = ResidualTracks(points, positions, torch.ones(positions.shape[:2]), nothing, nothing)
    places = cluster_places(points, nothing, torch.tensor([0]), positions.shape[1])
    return solve_residual(places, tracks, nothing, nothing[:, None], torch.zeros(n, 1), noise=noise, **options)[0]


def moved(points: Tensor) -> Tensor:
    centre = points.mean(0)
    return ((points - centre) @ TURN.T + centre + SHIFT)[:, None].expand(-1, FRAMES, -1).contiguous()


def test_full_and_planar_sets_give_the_motion() -> None:
    for flat in (3, 2):
        points = cloud(flat)
        motion = solved(points, moved(points))[2]
        torch.testing.assert_close(motion[:3, :3], TURN.double(), atol=1e-4, rtol=0)


def test_collinear_and_tiny_sets_only_shift() -> None:
    for points in (cloud(1), cloud(3, count=5)):
        motion = solved(points, moved(points))[2]
        torch.testing.assert_close(motion[:3, :3], torch.eye(3).double())
        centre = points.mean(0).double()
        torch.testing.assert_close(motion[:3, :3] @ centre + motion[:3, 3], centre + SHIFT.double(), atol=5e-3, rtol=0)


def test_a_mirrored_set_is_not_reflected() -> None:
    points = cloud()
    mirrored = points * torch.tensor([1.0, 1.0, -1.0]) + torch.tensor([0.0, 0.0, 1.4])
    motion = solved(points, mirrored[:, None].expand(-1, FRAMES, -1).contiguous())[0]
    assert torch.linalg.det(motion[:3, :3]) > 0.99


def test_outliers_do_not_count() -> None:
    points = cloud(count=60)
    positions = moved(points)
    positions[:18] += 0.2 * torch.randn(18, 1, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(solved(points, positions)[1, :3, :3], TURN.double(), atol=5e-3, rtol=0)


def test_noise_pulls_to_the_identity() -> None:
    points = cloud(count=8)
    positions = points[:, None] + 0.03 * torch.randn(8, FRAMES, 3, generator=torch.Generator().manual_seed(2))
    free = solved(points, positions, noise=0.03, shrink=False)
    shrunk = solved(points, positions, noise=0.03)
    eye = torch.eye(3).double()
    assert (shrunk[:, :3, :3] - eye).norm() < 0.5 * (free[:, :3, :3] - eye).norm()


def test_without_turns() -> None:
    points = cloud()
    torch.testing.assert_close(solved(points, moved(points), turn=False)[3, :3, :3], torch.eye(3).double())


def test_a_level_holds_the_canonical_frame_and_an_endless_filter_stills_a_basis() -> None:
    points = cloud()
    motion = solved(points, moved(points))[None].repeat(2, 1, 1, 1)
    places = cluster_places(points, torch.tensor([0, 1] * 20), torch.tensor([0, 0]), FRAMES)
    level = smoothed_level(places, motion, canonical=2, smoothing=torch.tensor([0.1, torch.inf]))
    assert level.displacements[0, 2].abs().max() < 1e-6
    assert level.displacements[0, 4].norm() > 0.01
    assert level.displacements[1].abs().max() < 1e-6
    torch.testing.assert_close(level.rotations_6d[1], torch.tensor([1.0, 0, 0, 0, 1, 0]).expand(FRAMES, 6))


def test_pull_back_undoes_a_level() -> None:
    points = cloud()
    places = cluster_places(points, torch.zeros(40, dtype=torch.long), torch.tensor([0]), FRAMES)
    motion = solved(points, moved(points))[None]
    level = smoothed_level(places, motion, canonical=0, smoothing=torch.tensor([0.0]))
    index, logit = torch.zeros(40, 1, dtype=torch.long), torch.zeros(40, 1)
    back = pull_back(level, index, logit, moved(points))
    torch.testing.assert_close(back[:, 3], points, atol=1e-4, rtol=0)


def test_the_filter_keeps_lines_and_bends_to_weights() -> None:
    line = torch.linspace(0, 1, 9)[:, None]
    torch.testing.assert_close(whittaker(line, torch.ones(9), 100.0), line)
    spike = torch.zeros(9, 1)
    spike[4] = 1
    assert whittaker(spike, torch.ones(9), 100.0)[4] < 0.3
    assert whittaker(spike, 1 + 1e4 * spike[:, 0], 100.0)[4] > 0.9
