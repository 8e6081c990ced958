"""Loss terms against values worked out by hand."""

import pytest
import torch

from lerobot_msdyn.reconstruction.losses import certain_pixels, depth_loss, mask_loss, rgb_loss


def test_rgb_is_the_mean_absolute_difference() -> None:
    drawn, recorded = torch.full((1, 2, 2, 3), 0.5), torch.full((1, 2, 2, 3), 0.25)
    recorded[0, 0, 0] = 0.5
    assert float(rgb_loss(drawn, recorded)) == pytest.approx(0.25 * 3 / 4)


def test_depth_compares_inverse_depth_where_known_and_drawn() -> None:
    known = torch.tensor([[[1.0, 2.0, 0.0, 1.0]]])
    drawn = torch.tensor([[[2.0, 2.0, 9.0, 9.0]]])
    alpha = torch.tensor([[[1.0, 1.0, 1.0, 0.1]]])
    # |1/2 - 1| and |1/2 - 1/2|, mean 0.25, over the mean inverse depth (1 + 1/2) / 2.
    assert float(depth_loss(drawn, known, alpha)) == pytest.approx(0.25 / 0.75)


def test_depth_of_nothing_known_is_zero_with_a_gradient() -> None:
    drawn = torch.ones(1, 2, 2, requires_grad=True)
    loss = depth_loss(drawn, torch.zeros(1, 2, 2), torch.ones(1, 2, 2))
    loss.backward()
    assert float(loss.detach()) == 0
    assert drawn.grad is not None
    assert not drawn.grad.any()


def test_mask_counts_only_certain_pixels() -> None:
    moving = torch.tensor([[[True, True, False, False]]])
    drawn = torch.tensor([[[1.0, 0.0, 1.0, 0.5]]])
    certain = torch.tensor([[[True, False, False, True]]])
    assert float(mask_loss(drawn, moving, certain)) == pytest.approx(0.25)


def test_certain_pixels_leave_out_a_band_at_the_border() -> None:
    moving = torch.zeros(1, 1, 9, dtype=torch.bool)
    moving[..., 5:] = True
    assert certain_pixels(moving, 1)[0, 0].tolist() == [True] * 4 + [False] * 2 + [True] * 3
