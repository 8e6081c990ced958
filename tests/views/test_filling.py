"""What stands where nobody has seen anything."""

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.config import Fill
from lerobot_msdyn.views.filling import filled, filled_softly, missing


def beside_an_object() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A grey wall at 1 m, a red object at 0.6 m before it, and a hole along the object's right side."""
    rgb, depth, alpha = torch.full((40, 60, 3), 0.5), torch.full((40, 60), 1.0), torch.ones(40, 60)
    rgb[10:30, 10:30], depth[10:30, 10:30] = torch.tensor([0.9, 0.0, 0.0]), 0.6
    hole = (slice(10, 30), slice(30, 36))
    rgb[hole], depth[hole], alpha[hole] = 0.0, 0.0, 0.0
    return rgb, alpha, depth


@pytest.mark.parametrize(("fill", "off"), [("inpaint", 0.02), ("nearest", 0.02), ("blur", 0.12)])
def test_what_an_object_hid_is_continued_from_behind_it(fill: Fill, off: float) -> None:
    rgb, alpha, depth = beside_an_object()
    found = filled(rgb, alpha, depth, fill)
    assert ((found[10:30, 30:36] - 0.5).abs() < off).all()
    assert torch.equal(found[:, :30], rgb[:, :30])


def test_noise_is_of_all_colours_and_the_same_in_every_picture() -> None:
    rgb, alpha, depth = beside_an_object()
    found = filled(rgb, alpha, depth, "noise")
    assert found[10:30, 30:36].std() > 0.2
    assert torch.equal(found[alpha > 0.5], rgb[alpha > 0.5])
    assert torch.equal(filled(rgb, alpha, depth, "noise"), found)


def test_beyond_the_border_the_picture_goes_on() -> None:
    rgb, alpha, depth = beside_an_object()
    alpha[:, 50:], rgb[:, 50:] = 0, 0
    assert (filled(rgb, alpha, depth, "inpaint")[:, 50:] > 0.4).all()


def test_nothing_or_everything_known() -> None:
    rgb = torch.rand(8, 8, 3)
    for alpha in (torch.ones(8, 8), torch.zeros(8, 8)):
        assert filled(rgb, alpha, torch.ones(8, 8), "inpaint").shape == rgb.shape
    assert torch.equal(filled(rgb, torch.ones(8, 8), torch.ones(8, 8), "inpaint"), rgb)


def test_solid_surfaces_are_left_as_they_are() -> None:
    assert missing(torch.tensor([0.0, 0.45, 0.9, 1.0])).tolist() == pytest.approx([1.0, 0.5, 0.0, 0.0])


def test_soft_filling_takes_the_colour_around_a_hole() -> None:
    rgb = np.full((3, 40, 60), 100, np.uint8)
    rgb[:, :, 30:] = 200
    known = np.ones((40, 60), bool)
    known[10:30, 5:15] = False
    rgb[:, ~known] = 0
    found = filled_softly(rgb, known)
    assert np.abs(found[:, ~known].astype(int) - 100).max() < 15
    assert (found[:, known] == rgb[:, known]).all()
    assert (filled_softly(rgb, np.zeros_like(known)) == rgb).all(), "with nothing known nothing is invented"
    single = np.zeros_like(known)
    single[20, 30] = True
    assert np.abs(filled_softly(rgb, single)[:, ~single].astype(int) - 200).max() < 5
