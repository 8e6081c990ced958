"""Sets of Gaussians."""

import torch

from lerobot_msdyn.scene.gaussians import Gaussians, concatenate, gaussians_from_points


def test_points_become_gaussians() -> None:
    gaussians = gaussians_from_points(
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 0.02),
        torch.tensor([[0.1, 0.5, 0.9]]),
        0.7,
    )
    torch.testing.assert_close(gaussians.log_scales.exp(), torch.full((1, 3), 0.02))
    torch.testing.assert_close(gaussians.opacity_logits.sigmoid(), torch.tensor([0.7]))
    torch.testing.assert_close(gaussians.rgb, torch.tensor([[0.1, 0.5, 0.9]]))


def test_select_and_concatenate_undo_each_other(gaussians: Gaussians) -> None:
    parts = [gaussians.select(torch.tensor([0, 1])), gaussians.select(torch.tensor([2, 3, 4]))]
    torch.testing.assert_close(concatenate(parts).means, gaussians.means)
    torch.testing.assert_close(concatenate(parts).sh, gaussians.sh)
