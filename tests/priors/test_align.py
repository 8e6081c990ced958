"""Depth of unknown scale against a reference."""

import pytest
import torch

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.priors.depth.align import align_disparity, align_scale


def test_disparity_is_aligned_in_spite_of_outliers() -> None:
    generator = torch.Generator().manual_seed(0)
    truth = 0.5 + 2 * torch.rand(3, 20, 20, generator=generator)
    disparity = 7 / truth - 1.5
    reference = truth.clone()
    reference[:, :6] = 3.0  # 30 % of the reference is wrong
    torch.testing.assert_close(align_disparity(disparity, reference), truth, atol=1e-3, rtol=0)


def test_a_disparity_that_runs_the_wrong_way_is_refused() -> None:
    reference = 1 + torch.rand(2, 8, 8, generator=torch.Generator().manual_seed(0))
    with pytest.raises(PriorError, match="larger where things are nearer"):
        align_disparity(-1 / reference, reference)


def test_only_usable_pixels_count() -> None:
    reference = 1 + torch.rand(9, 8, 8, generator=torch.Generator().manual_seed(0))
    truth = reference.clone()
    reference[:, :5] = 9.0
    usable = torch.zeros(9, 8, 8, dtype=torch.bool)
    usable[:, 5:] = True
    torch.testing.assert_close(align_disparity(3 / truth + 1, reference, usable), truth, atol=1e-3, rtol=0)


def test_a_scale_is_the_median_ratio() -> None:
    reference = 1 + torch.rand(4, 8, 8, generator=torch.Generator().manual_seed(0))
    depth = reference / 2.5
    depth[0, 0, 0], depth[0, 0, 1], reference[1] = torch.nan, 0.0, 0.0
    aligned = align_scale(depth, reference)
    assert (aligned[0, 0, :2] == 0).all()
    torch.testing.assert_close(aligned[2:], reference[2:])


def test_without_a_common_pixel_there_is_no_scale() -> None:
    depth = torch.ones(2, 8, 8)
    with pytest.raises(PriorError, match="aligned at 0 pixels only"):
        align_scale(depth, torch.zeros_like(depth))


def test_far_disparity_stays_bounded() -> None:
    reference = 1 + torch.rand(2, 8, 8, generator=torch.Generator().manual_seed(0))
    disparity = 1 / reference
    disparity[0, 0, 0] = -3.0
    aligned = align_disparity(disparity, reference)
    assert aligned[0, 0, 0].item() == pytest.approx(2 * reference.max().item())
