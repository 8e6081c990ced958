"""The gradient of every loss term by everything that a fit changes, against finite differences."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from motion_levels import of_bases
from moving_cards import at_frame, moving_cards, targets_of
from torch import Tensor

from lerobot_msdyn.core.registries import LOSSES
from lerobot_msdyn.reconstruction.losses.rigidity import nearest_of_part, rigidity_loss
from lerobot_msdyn.reconstruction.losses.ssim import ssim_loss
from lerobot_msdyn.scene.dynamic import DynamicScene

FRAME = 1
STEP = 1e-6
TERMS = ["rgb", "mask", "depth", "ssim", "track", "rigidity"]


def leaves_of(scene: DynamicScene) -> dict[str, Tensor]:
    (level,) = of_bases(scene.levels)
    return {
        "static colours": scene.static.sh,
        "static means": scene.static.means,
        "means": scene.moving.means,
        "colours": scene.moving.sh,
        "opacities": scene.moving.opacity_logits,
        "turns": level.rotations_6d,
        "shifts": level.displacements,
        "weights": scene.logits[0],
    }


def with_leaves(scene: DynamicScene, leaves: dict[str, Tensor]) -> DynamicScene:
    (level,) = of_bases(scene.levels)
    level = replace(level, rotations_6d=leaves["turns"], displacements=leaves["shifts"])
    return replace(
        scene,
        static=replace(scene.static, sh=leaves["static colours"], means=leaves["static means"]),
        moving=replace(scene.moving, means=leaves["means"], sh=leaves["colours"], opacity_logits=leaves["opacities"]),
        levels=(level,),
        logits=(leaves["weights"],),
    )


def loss_of(term: str, scene: DynamicScene) -> Callable[[dict[str, Tensor]], Tensor]:
    targets = targets_of(scene)
    neighbours = nearest_of_part(scene, torch.arange(len(scene.moving)))

    def loss(leaves: dict[str, Tensor]) -> Tensor:
        now = with_leaves(scene, leaves)
        if term == "rigidity":  # who is whose neighbour is not differentiated
            return rigidity_loss(now, neighbours, torch.tensor([FRAME, FRAME + 2]))
        return LOSSES.get(term)(at_frame(now, FRAME, targets))

    return loss


@pytest.mark.parametrize("term", TERMS)
def test_gradients_agree_with_finite_differences(term: str) -> None:
    scene = moving_cards()
    loss = loss_of(term, scene)
    leaves = {name: leaf.clone().requires_grad_() for name, leaf in leaves_of(scene).items()}
    loss(leaves).backward()
    generator = torch.Generator().manual_seed(0)
    moved = 0
    for name, leaf in leaves.items():
        gradient = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        direction = torch.randn(leaf.shape, generator=generator, dtype=leaf.dtype)
        plain = {other: tensor.detach() for other, tensor in leaves.items()}
        ahead, behind = (float(loss(plain | {name: plain[name] + way * STEP * direction})) for way in (1, -1))
        expected = (ahead - behind) / (2 * STEP)
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=2e-3, abs=1e-6), name
        moved += expected != 0
    assert moved >= {"rgb": 8, "ssim": 8, "track": 6, "depth": 6, "mask": 4, "rigidity": 4}[term]


@pytest.mark.parametrize("term", ["track", "rigidity"])
def test_what_holds_motion_reaches_bases_and_weights(term: str) -> None:
    scene = moving_cards()
    leaves = {name: leaf.clone().requires_grad_() for name, leaf in leaves_of(scene).items()}
    loss_of(term, scene)(leaves).backward()
    for name in ("turns", "shifts", "weights"):
        gradient = leaves[name].grad
        assert gradient is not None
        assert bool(gradient.any())


def test_the_track_loss_is_zero_where_points_are_carried_to_their_tracks_and_grows_with_the_error() -> None:
    scene = moving_cards(part_alone=True)
    targets = targets_of(scene)
    right = float(LOSSES.get("track")(at_frame(scene, FRAME, targets)))
    (level,) = of_bases(scene.levels)
    off = level.displacements.clone()
    off[:, [0, 2, 3]] += torch.tensor([0.4, 0.0, 0.0], dtype=off.dtype)
    wrong = replace(scene, levels=(replace(level, displacements=off),))
    assert right < 0.05  # at the edges of cards the wall mixes in
    assert float(LOSSES.get("track")(at_frame(wrong, FRAME, targets))) > 4 * right


def test_rigid_parts_have_no_rigidity_loss_however_they_move_and_bent_ones_have() -> None:
    rigid, bent = moving_cards(part_alone=True), moving_cards()
    targets = targets_of(rigid)
    assert float(LOSSES.get("rigidity")(at_frame(rigid, FRAME, targets))) == pytest.approx(0, abs=1e-6)
    assert float(LOSSES.get("rigidity")(at_frame(bent, FRAME, targets))) > 1e-3


@pytest.mark.parametrize("term", ["track", "rigidity"])
def test_without_anything_that_moves_there_is_no_loss(term: str) -> None:
    scene = moving_cards()
    targets = targets_of(scene)
    still = scene.still()
    means = still.moving.means.clone().requires_grad_()
    still = replace(still, moving=replace(still.moving, means=means))
    loss = LOSSES.get(term)(at_frame(still, FRAME, targets))
    loss.backward()
    assert float(loss.detach()) == 0


def test_ssim_of_equal_pictures_is_zero_and_of_opposite_ones_more_than_one() -> None:
    picture = torch.rand(1, 20, 24, 3, generator=torch.Generator().manual_seed(0))
    assert float(ssim_loss(picture, picture)) == pytest.approx(0, abs=1e-5)
    assert float(ssim_loss(picture, 1 - picture)) > 1
