"""What a fit changes: which tensors take part, and what holds."""

from dataclasses import replace

import torch
from motion_levels import of_bases
from moving_cards import FRAMES, moving_cards
from torch import Tensor

from lerobot_msdyn.core.config import FitConfig
from lerobot_msdyn.motion.model.bases import level_affines
from lerobot_msdyn.reconstruction.parameters import Parameters
from lerobot_msdyn.scene.dynamic import DynamicScene

CANONICAL = 0


def config(*, bases: bool = False, weights: bool = False) -> FitConfig:
    made = FitConfig(steps=10)
    made.learn.bases, made.learn.weights = bases, weights
    return made


def stepped(parameters: Parameters, steps: int = 3) -> DynamicScene:
    """After some steps that pull all that moves to a place."""
    for _ in range(steps):
        moving = parameters.scene.at(torch.arange(FRAMES)).means[:, -32:]
        parameters.step((moving - torch.tensor([1.0, 2.0, 3.0]).double()).abs().sum())
    return parameters.result()


def carried(scene: DynamicScene, frame: int) -> Tensor:
    return level_affines(of_bases(scene.levels)[0], torch.tensor([frame]))


def test_motion_stays_where_it_is_not_learned_or_has_not_begun() -> None:
    scene = moving_cards()
    for parameters in (
        Parameters(scene, config(), 1.0),
        Parameters(scene, config(bases=True, weights=True), 1.0),  # `begin_motion` was not called
    ):
        after = stepped(parameters)
        assert torch.equal(carried(after, 2), carried(scene, 2))
        assert torch.equal(after.logits[0], scene.logits[0])
        assert not torch.equal(after.moving.means, scene.moving.means)


def test_bases_and_weights_are_learned_each_alone_and_the_canonical_frame_stays() -> None:
    scene = moving_cards()
    for bases, weights in ((True, False), (False, True), (True, True)):
        parameters = Parameters(scene, config(bases=bases, weights=weights), 1.0)
        parameters.begin_motion()
        after = stepped(parameters)
        assert torch.equal(carried(after, 2), carried(scene, 2)) is not bases
        assert torch.equal(after.logits[0], scene.logits[0]) is not weights
        assert torch.equal(carried(after, CANONICAL), carried(scene, CANONICAL))
        assert not any(tensor.requires_grad for tensor in after.tensors().values())


def test_another_canonical_frame_stays_as_well() -> None:
    scene = replace(moving_cards(), canonical_frame=2)
    parameters = Parameters(scene, config(bases=True), 1.0)
    parameters.begin_motion()
    after = stepped(parameters)
    assert torch.equal(carried(after, 2), carried(scene, 2))
    assert not torch.equal(carried(after, 1), carried(scene, 1))


def test_a_basis_without_doubt_and_an_inactive_one_are_left_alone() -> None:
    scene = moving_cards()
    (level,) = of_bases(scene.levels)
    inactive = replace(scene, levels=(replace(level, active=torch.tensor([True, False])),))
    for given, doubt in ((scene, [torch.tensor([1.0, 0.0])]), (inactive, [])):
        parameters = Parameters(given, config(bases=True), 1.0, doubt)
        parameters.begin_motion()
        after = stepped(parameters)
        same = (carried(after, 2) == carried(given, 2)).flatten(1).all(1)
        assert same.tolist() == [False, True]


def test_the_rate_of_a_basis_goes_with_its_doubt() -> None:
    scene = moving_cards()
    shifts = []
    for doubt in (1.0, 0.25):
        parameters = Parameters(scene, config(bases=True), 1.0, [torch.full((2,), doubt)])
        parameters.begin_motion()
        after = stepped(parameters, 1)
        shifts.append((of_bases(after.levels)[0].displacements - of_bases(scene.levels)[0].displacements).abs().max())
    torch.testing.assert_close(shifts[1], shifts[0] / 4, rtol=1e-3, atol=0)


def test_groups_of_ones_own_take_part() -> None:
    mine = torch.zeros(3, requires_grad=True)
    parameters = Parameters(moving_cards(), config(), 1.0, learned=[{"params": [mine], "lr": 0.1}])
    parameters.step((mine - 1).square().sum())
    assert bool((mine > 0).all())
