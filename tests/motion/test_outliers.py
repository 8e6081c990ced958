"""Tracks that their neighbours contradict."""

import torch

from lerobot_msdyn.motion.from_tracks.outliers import coherence


def test_what_slips_is_not_trusted_and_what_bends_is() -> None:
    generator = torch.Generator().manual_seed(0)
    points = 0.1 * torch.rand(100, 3, generator=generator)
    bend = 0.3 * points[:, None, :1] * torch.linspace(0, 1, 20)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    positions = points[:, None] + bend + 1e-4 * torch.randn(100, 20, 3, generator=generator)
    positions[7, 10:] += 0.05
    trust = coherence(
        points, positions, torch.ones(100, 20, dtype=torch.bool), torch.zeros(100, dtype=torch.long), 1e-4
    )
    assert trust[7, 10:].max() < 0.01
    assert trust[7, :10].median() > 0.5
    assert trust[8:].median() > 0.9


def test_few_tracks_are_all_trusted() -> None:
    trust = coherence(
        torch.zeros(3, 3), torch.randn(3, 4, 3), torch.ones(3, 4) > 0, torch.zeros(3, dtype=torch.long), 0.0
    )
    assert (trust == 1).all()
