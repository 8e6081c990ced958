"""Rigid motions of groups of tracks."""

import torch
from torch import Tensor

from lerobot_msdyn.core.geometry import transform_points
from lerobot_msdyn.motion.from_tracks.rigid import fit_rigid, model_points, residuals


def worst_error(motions: Tensor, truth: Tensor, points: Tensor) -> float:
    """Largest distance (m) between points moved by estimated and by true motions."""
    moved = [transform_points(m, points.double().expand(len(truth), -1, -1)) for m in (motions, truth.double())]
    return float((moved[0] - moved[1]).norm(dim=-1).max())


def reference(weights: Tensor) -> int:
    return int((weights > 0).sum(0).argmax())


def test_clean_tracks(tumbling) -> None:
    weights = torch.ones(60, 24)
    fit = fit_rigid(tumbling.xyz, weights[None])
    assert (fit.support > 0).all()
    assert worst_error(fit.motions[0], tumbling.relative(0), tumbling.points) < 1e-5


def test_outliers_and_occlusion(tumbling) -> None:
    """30 % of the tracks go elsewhere; no track is seen for longer than 16 of 24 frames."""
    generator = torch.Generator().manual_seed(0)
    xyz = tumbling.xyz
    xyz[:18] += 0.3 * torch.randn(18, 24, 3, generator=generator)
    weights = torch.zeros(60, 24)
    for row in range(60):
        start = 2 * (row % 5)
        weights[row, start : start + 16] = 1
    fit = fit_rigid(xyz, weights[None])
    t0 = reference(weights)
    assert (fit.support > 0).all()
    points = tumbling.xyz[:, t0]
    assert worst_error(fit.motions[0], tumbling.relative(t0), points) < 1e-4


def test_frames_are_chained_through_tracks_they_share(tumbling) -> None:
    """No track is seen both at the start and at the end."""
    weights = torch.zeros(60, 24)
    weights[:20, :10], weights[20:40, 7:17], weights[40:, 14:] = 1, 1, 1
    fit = fit_rigid(tumbling.xyz, weights[None])
    t0 = reference(weights)
    assert (fit.support > 0).all()
    assert worst_error(fit.motions[0], tumbling.relative(t0), tumbling.xyz[:, t0]) < 1e-4


def test_groups_are_independent(tumbling, resting) -> None:
    xyz = torch.cat((tumbling.xyz, resting.xyz))
    weights = torch.zeros(2, 120, 24)
    weights[0, :60], weights[1, 60:] = 1, 1
    fit = fit_rigid(xyz, weights)
    assert worst_error(fit.motions[0], tumbling.relative(0), tumbling.points) < 1e-5
    assert worst_error(fit.motions[1], resting.relative(0), resting.points) < 1e-9


def test_a_mirrored_set_is_not_reflected(tumbling) -> None:
    """From the second frame on the points are mirrored: the best rigid motion is still a rotation."""
    xyz = tumbling.xyz[:, :2].clone()
    xyz[:, 1] = xyz[:, 0] * torch.tensor([-1.0, 1.0, 1.0])
    fit = fit_rigid(xyz, torch.ones(1, 60, 2))
    torch.testing.assert_close(torch.linalg.det(fit.motions[0, :, :3, :3]), torch.ones(2, dtype=torch.float64))


def test_too_few_tracks_are_not_accepted(tumbling) -> None:
    weights = torch.ones(60, 24)
    weights[3:, 10:14] = 0
    fit = fit_rigid(tumbling.xyz, weights[None])
    assert (fit.support[0] == 0).nonzero()[:, 0].tolist() == [10, 11, 12, 13]


def test_model_and_residuals_of_one_stray_track(tumbling) -> None:
    xyz = tumbling.xyz
    fit = fit_rigid(xyz, torch.ones(1, 60, 24))
    xyz[5, 7] += torch.tensor([0.0, 0.24, 0.0])
    points, known = model_points(xyz, torch.ones(60, 24), fit)
    assert known.all()
    distance = residuals(xyz, points, fit)[0]
    # its model point is off by 1/24 of the jump everywhere, and by the rest where it jumps
    torch.testing.assert_close(distance[5, 7], torch.tensor(0.23, dtype=torch.float64), atol=1e-4, rtol=0)
    assert distance[6:].max() < 1e-5
