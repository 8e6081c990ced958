"""Gains over time: how they are kept, and what is between frames."""

import torch

from lerobot_msdyn.scene.shading import Shading, decode_gain, encode_gain, no_shading


def test_gains_survive_their_coding_to_a_third_of_a_percent() -> None:
    gain = torch.linspace(0.5, 2, 1000)
    again = decode_gain(encode_gain(gain))
    assert ((again / gain - 1).abs() < 0.003).all()
    assert decode_gain(encode_gain(torch.tensor([1.0]))).item() == 1
    limits = decode_gain(encode_gain(torch.tensor([0.0, 1e9])))
    torch.testing.assert_close(limits, torch.tensor([0.5, 2.0]))


def shading() -> Shading:
    """Dark on the left and bright on the right at the second frame."""
    field = encode_gain(torch.tensor([[[1.0, 1.0]], [[0.5, 2.0]]]))
    return Shading(
        field, torch.tensor([[-0.5, 0.0], [0.5, 0.0], [9.0, 0.0]]), encode_gain(torch.tensor([[1.0], [2.0]]))
    )


def test_a_static_gaussian_has_the_gain_of_its_place() -> None:
    gain = shading().static_gain(torch.tensor([0, 1]))
    torch.testing.assert_close(gain, torch.tensor([[1.0, 1.0, 1.0], [0.5, 2.0, 2.0]]))  # outside: the nearest


def test_between_frames_gains_are_interpolated_and_outside_held() -> None:
    moving = shading().moving_gain(torch.tensor([-3.0, 0.5, 1.0, 7.0]))
    torch.testing.assert_close(moving[:, 0], torch.tensor([1.0, 2**0.5, 2.0, 2.0]), atol=0.005, rtol=0)


def test_no_shading_is_one_everywhere() -> None:
    none = no_shading(3, 2, 5)
    assert (none.static_gain(torch.arange(5)) == 1).all()
    assert none.moving_gain(torch.tensor([4])).tolist() == [[1, 1]]
