"""Colours of what moves from a place: the compiled route against torch in double precision."""

import torch
from torch import Tensor

from lerobot_msdyn.scene.gaussians import SH_C1
from lerobot_msdyn.scene.seen import shaded_moving


def colours_and_gradients(kind: torch.dtype, count: int = 5000, times: int = 2) -> list[Tensor]:
    generator = torch.Generator().manual_seed(3)
    shapes = ((count, 4, 3), (count, 4), (times, count, 4), (times, count, 3))
    given = [torch.randn(shape, generator=generator).to(kind).requires_grad_() for shape in shapes]
    eye, towards = (torch.randn(shape, generator=generator).to(kind) for shape in ((times, 3), (times, count, 3)))
    sh, canonical, quats, means = given
    colours = shaded_moving(sh, canonical, quats, means, 4 * eye)
    (colours * towards).sum().backward()
    return [colours, *(each.grad for each in given if each.grad is not None)]


def test_the_compiled_route_equals_torch_in_double_precision() -> None:
    compiled, plain = colours_and_gradients(torch.float32), colours_and_gradients(torch.float64)
    assert len(compiled) == len(plain) == 5
    for one, other in zip(compiled, plain, strict=True):
        torch.testing.assert_close(one.double(), other, atol=2e-6 * float(other.detach().abs().max()), rtol=0)


def test_a_side_keeps_its_colour_where_it_turns() -> None:
    """Seen from +x before and after half a turn about z: what was the other side comes into view."""
    sh = torch.zeros(1, 4, 3)
    sh[0, 3] = 0.5
    unturned, turned = torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[0.0, 0, 0, 1]])
    means, eye = torch.zeros(1, 1, 3), torch.tensor([[2.0, 0, 0]])
    before = shaded_moving(sh, unturned, unturned[None], means, eye)
    after = shaded_moving(sh, unturned, turned[None], means, eye)
    torch.testing.assert_close(before[0, 0], torch.full((3,), 0.5 + 0.5 * SH_C1))
    torch.testing.assert_close(after[0, 0], torch.full((3,), 0.5 - 0.5 * SH_C1))
