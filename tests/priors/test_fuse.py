"""A network's depth and the ground: what is aligned, what is put on the ground, and what moves."""

import pytest
import torch

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.priors.depth.fuse import BEYOND_WALL, NEAR_GROUND, fused
from lerobot_msdyn.priors.depth.table_plane import table_plane, with_standing

WIDTH, HEIGHT, FRAMES = 64, 48, 12
K = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])
GROUND = table_plane(WIDTH, HEIGHT, K, height_m=0.5, tilt_deg=35.0)
NOTHING = torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.uint8)
BOX = (slice(14, 34), slice(8, 24))  # stands on the ground, its foot in row 33
UPPER = (slice(14, 26), BOX[1])  # of it, well above the ground behind


def scene() -> torch.Tensor:
    """True depth: the ground, a box and a wall from row 6 up, nearer than the one that is assumed."""
    depth = GROUND.clone()
    depth[:6] = depth[6, 0]
    depth[BOX] = GROUND[33, 0]
    return depth


def clip(depth: torch.Tensor) -> torch.Tensor:
    return depth.expand(FRAMES, -1, -1).clone()


def put_together(inverse: torch.Tensor, instances: torch.Tensor = NOTHING, **other) -> torch.Tensor:
    settings = {"elsewhere": None, "shifted": True, "known": True} | other
    return fused(inverse, instances, GROUND, with_standing(GROUND, instances), **settings)


@pytest.mark.parametrize(("scale", "shift", "shifted"), [(3.0, -0.7, True), (0.2, 0.5, True), (2.5, 0.0, False)])
def test_a_network_is_aligned_by_the_ground_whatever_stands_on_it(scale: float, shift: float, shifted: bool) -> None:
    truth = clip(scene())
    found = put_together((1 / truth - shift) / scale, shifted=shifted)
    torch.testing.assert_close(found[0][UPPER], truth[0][UPPER], rtol=2e-3, atol=0)
    torch.testing.assert_close(found, truth, rtol=NEAR_GROUND[0], atol=0)  # a box's foot is near enough to be ground
    assert ((found / truth - 1).abs() > 2e-3).float().mean() < 0.05


def test_what_is_near_the_ground_lies_on_it_and_nothing_is_below() -> None:
    noise = 0.04 * torch.randn(FRAMES, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    wavy = 1 / clip(scene()) * (1 + noise)
    wavy[:, 40:44, 40:44] /= 1.5  # said to be below the ground
    found = put_together(wavy)
    below = slice(36, 48)
    torch.testing.assert_close(found[:, below], clip(GROUND)[:, below], rtol=1e-4, atol=0)
    ground = GROUND.max() > GROUND  # the wall behind it is only assumed
    assert (found <= 1.0001 * clip(GROUND))[:, ground].all()
    assert (found <= 1.0001 * BEYOND_WALL * clip(GROUND)).all()
    torch.testing.assert_close(found[0, 16:32, 10:22].median(), GROUND[33, 0], rtol=0.03, atol=0)


def test_an_assumed_ground_gives_scale_and_shift_and_no_more() -> None:
    noise = 0.04 * torch.randn(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    found = put_together(clip(7 / GROUND * (1 + noise)), known=False)
    assert (found[0] / GROUND - 1).abs().mean() > 0.02
    assert (found[0] / GROUND).median().item() == pytest.approx(1, abs=0.02)


def test_what_stands_still_has_one_depth() -> None:
    flicker = 1 + 0.05 * torch.randn(FRAMES, 1, 1, generator=torch.Generator().manual_seed(0))
    found = put_together(1 / clip(scene()) * flicker)
    assert (found == found[0]).all()


def test_other_episodes_decide_alike_for_all() -> None:
    """What a clip says of its own scale does not count where frames of all episodes are at hand."""
    truth = clip(scene())
    elsewhere = 2 / truth[:5] - 0.3
    one, another = (put_together(factor / truth - 0.3, elsewhere=elsewhere) for factor in (2.0, 2.6))
    assert torch.equal(one, another)
    torch.testing.assert_close(one[0][UPPER], truth[0][UPPER], rtol=2e-3, atol=0)


def thing(distance: float, foot: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """A moving upright thing whose foot is in some row, and a network's inverse depth with it `distance` feet away."""
    instances, depth = NOTHING.clone(), clip(scene())
    for frame in range(FRAMES):
        where = (frame, slice(foot - 29, foot + 1), slice(30 + frame, 36 + frame))
        instances[where] = 1
        depth[where] = distance * GROUND[foot, 0]
    return 3 / depth - 0.2, instances


def test_a_thing_behind_its_own_foot_is_brought_to_it() -> None:
    inverse, instances = thing(1.4)
    found = put_together(inverse, instances)
    foot = GROUND[40, 0].item()
    assert found[instances > 0].mean().item() == pytest.approx(foot, rel=0.03)


@pytest.mark.parametrize("distance", [0.7, 1.0, 1.08])
def test_a_thing_that_the_network_sees_well_keeps_its_depth(distance: float) -> None:
    """Also one that is lifted, and so nearer than the ground under its lowest rows."""
    inverse, instances = thing(distance)
    found = put_together(inverse, instances)
    assert found[instances > 0].median().item() == pytest.approx(distance * GROUND[40, 0].item(), rel=0.02)


def rough(inverse: torch.Tensor, share: float) -> torch.Tensor:
    """What a network says that is off by as much everywhere."""
    noise = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0)) * 2 - 1
    return inverse * (1 + share * noise)


@pytest.mark.parametrize(("share", "distance"), [(0.003, 0.7), (0.12, 1.0)])
def test_what_moves_stands_on_its_foot_where_the_network_is_poor(share: float, distance: float) -> None:
    inverse, instances = thing(0.7)
    found = put_together(rough(inverse, share), instances)
    assert found[instances > 0].median().item() == pytest.approx(distance * GROUND[40, 0].item(), rel=0.06)


@pytest.mark.parametrize(("share", "part"), [(0.003, 0.0), (0.12, 0.5)])
def test_a_poor_network_is_averaged_with_what_is_told_to_stand_without_it(share: float, part: float) -> None:
    told = GROUND.clone()
    told[UPPER] = 0.8 * GROUND[33, 0]
    found = fused(rough(1 / clip(scene()), share), NOTHING, GROUND, clip(told), None, shifted=True, known=True)
    inverse = (1 - part) / scene()[UPPER] + part / told[UPPER]
    assert (1 / found[0][UPPER]).median().item() == pytest.approx(inverse.median().item(), rel=0.05)


def test_what_moves_is_not_below_the_ground() -> None:
    instances, depth = NOTHING.clone(), clip(scene())
    instances[:, 30:46, 20:50] = 1  # lies on the ground, and the network is off
    depth[:, 30:46, 20:50] *= 1.1
    found = put_together(1 / depth, instances)
    assert (found <= 1.0001 * GROUND).all()


def test_unknown_depth_of_what_moves_stays_unknown() -> None:
    inverse, instances = thing(1.0)
    inverse[3, 20:25, 33:36] = torch.nan
    assert (put_together(inverse, instances)[3, 20:25, 33:36] == 0).all()


def test_depth_that_has_nothing_of_the_ground_is_refused_in_a_line() -> None:
    noise = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0)) ** 4
    with pytest.raises(PriorError, match=r"agrees with the ground in \d+ % of its pixels; expected 15 %") as caught:
        put_together(clip(noise + 1e-3), shifted=False)
    assert "\n" not in str(caught.value)
    with pytest.raises(PriorError, match="unknown where the ground is seen"):
        put_together(torch.full((FRAMES, HEIGHT, WIDTH), torch.nan))
