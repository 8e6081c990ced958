"""Levels as one carry points where they do one by one, and so do their gradients."""

import dataclasses

import pytest
import torch
from motion_levels import of_bases
from moving_cards import FRAMES, in_single, moving_cards
from torch import Tensor

from lerobot_msdyn.motion.model import composed
from lerobot_msdyn.motion.model.bases import identity_level
from lerobot_msdyn.motion.model.compose import compose
from lerobot_msdyn.scene.dynamic import DynamicScene


@pytest.fixture
def scene() -> DynamicScene:
    """Two levels, of which each Gaussian follows two bases and one, and a third that moves nothing."""
    scene = in_single(moving_cards())
    other = in_single(moving_cards(part_alone=True))
    idle = identity_level(torch.zeros(1, 3), FRAMES)
    idle = dataclasses.replace(idle, active=torch.zeros_like(idle.active))
    alone = torch.zeros(len(scene.moving), 1)
    return dataclasses.replace(
        scene,
        levels=(*scene.levels, *other.levels, idle),
        indices=(*scene.indices, *other.indices, alone.long()),
        logits=(*scene.logits, *other.logits, alone),
    )


def carried(scene: DynamicScene, times: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """Means and orientations at some times, and the gradients of those at the canonical frame."""
    means, quats = (values.clone().requires_grad_() for values in (scene.moving.means, scene.moving.quats))
    results = compose(means, quats, scene.levels, scene.indices, scene.logits, times)
    random = torch.Generator().manual_seed(0)
    torch.autograd.backward(results, [torch.randn(values.shape, generator=random) for values in results])
    return [values.detach() for values in results], [
        values.grad for values in (means, quats) if values.grad is not None
    ]


@pytest.mark.parametrize("times", [[2], [0, 3], [1.5]])
def test_carries_points_as_the_levels_do(scene: DynamicScene, times: list[float]) -> None:
    when = torch.tensor(times)
    one = scene.composed()
    assert len(one.levels) == 1
    for values, expected in zip(carried(one, when), carried(scene, when), strict=True):
        assert len(values) == 2
        for value, wanted in zip(values, expected, strict=True):
            torch.testing.assert_close(value, wanted, atol=2e-6, rtol=0)
    frames = when.long()
    torch.testing.assert_close(one.positions(frames), scene.positions(frames), atol=2e-6, rtol=0)


def test_some_of_the_points(scene: DynamicScene) -> None:
    rows, when = torch.tensor([3, 31, 3, 17]), torch.tensor([3])
    some, expected = scene.composed().select_moving(rows), scene.select_moving(rows)
    torch.testing.assert_close(some.at(when).means, expected.at(when).means, atol=2e-6, rtol=0)
    again = some.decomposed()
    for name in ("indices", "logits"):
        assert all(
            torch.equal(one, two) for one, two in zip(getattr(again, name), getattr(expected, name), strict=True)
        )
    assert again.levels == scene.levels
    assert scene.decomposed() is scene


def test_frames_are_composed_once_as_far_as_there_is_room(scene: DynamicScene, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[None] = []
    add_level = composed.add_level
    monkeypatch.setattr(composed, "add_level", lambda *given: calls.append(add_level(*given)))
    one = scene.composed(most_bytes=2 * len(scene.moving) * 64)
    for frame in (0, 1, 2):
        for _ in range(3):
            one.at(torch.tensor([frame]))
    assert len(calls) == 2 * (1 + 1 + 3), "of two levels that move something; the third frame finds no room"


def test_what_cannot_be_composed_stays_as_it_is(scene: DynamicScene) -> None:
    first, *others = of_bases(scene.levels)
    level = dataclasses.replace(first, displacements=first.displacements.clone().requires_grad_())
    learned = dataclasses.replace(scene, levels=(level, *others))
    assert learned.composed() is learned
    precise = moving_cards()
    assert precise.composed() is precise
    still = scene.still()
    assert still.composed() is still
