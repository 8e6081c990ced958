"""Density control: what it keeps, clones, splits and prunes, and that all that belongs to a Gaussian stays with it."""

from dataclasses import replace

import pytest
import torch
from moving_cards import FRAMES, HEIGHT, WIDTH, at_frame, moving_cards, targets_of

from lerobot_msdyn.core.config import DensityConfig, FitConfig
from lerobot_msdyn.reconstruction.density import Density, controlled, image_gradients
from lerobot_msdyn.reconstruction.losses.rgb import rgb
from lerobot_msdyn.reconstruction.parameters import Parameters, Resampled
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import Gaussians, gaussians_from_points
from lerobot_msdyn.scene.rendering import render_snapshot
from lerobot_msdyn.scene.shading import no_shading

CONFIG = DensityConfig(gradient=1.0, clone_size=0.1, min_opacity=0.05, max_size=1.0)


def row_of(sizes: list[float], opacity: float = 0.9) -> Gaussians:
    count = len(sizes)
    means = torch.arange(count * 3.0).reshape(count, 3)
    upright = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    scales = torch.tensor(sizes)[:, None].expand(count, 3)
    return gaussians_from_points(means, upright, scales, torch.full((count, 3), 0.5), opacity)


def round_of(gaussians: Gaussians, gradient: list[float], most: int = 100) -> Resampled:
    return controlled(gaussians, torch.tensor(gradient), CONFIG, 1.0, most, torch.Generator().manual_seed(0))


def test_small_gaussians_of_large_gradient_are_cloned() -> None:
    new = round_of(row_of([0.01, 0.01]), [0.5, 2.0])
    assert new.rows.tolist() == [0, 1, 1]
    assert new.fresh.tolist() == [False, False, True]
    assert torch.equal(new.gaussians.means[1], new.gaussians.means[2])


def test_large_ones_are_split_into_two_smaller_ones_inside_them() -> None:
    gaussians = row_of([0.2, 0.2])
    new = round_of(gaussians, [0.5, 2.0])
    assert new.rows.tolist() == [0, 1, 1]
    assert new.fresh.tolist() == [False, True, True]
    assert torch.allclose(new.gaussians.scales[1:], torch.tensor(0.2 / 1.6))
    away = (new.gaussians.means[1:] - gaussians.means[1]).norm(dim=-1)
    assert bool((away > 0).all())
    assert bool((away < 4 * 0.2).all())


def test_faint_and_huge_ones_are_pruned_whatever_their_gradient() -> None:
    gaussians = row_of([0.01, 2.0, 0.01])
    faint = replace(gaussians, opacity_logits=torch.logit(torch.tensor([0.9, 0.9, 0.01])))
    assert round_of(faint, [0.0, 9.0, 9.0]).rows.tolist() == [0]


def test_a_set_does_not_outgrow_its_bound_and_the_largest_gradients_come_first() -> None:
    new = round_of(row_of([0.01] * 4), [2.0, 5.0, 3.0, 4.0], most=6)
    assert sorted(new.rows.tolist()) == [0, 1, 1, 2, 3, 3]


def test_gradients_in_the_image_are_those_by_the_place_itself() -> None:
    scene = moving_cards()
    camera = targets_of(scene).view.camera.select([0])
    means = scene.positions(torch.tensor([0])).clone().requires_grad_()
    focal, generator = camera.intrinsics[0, 0, 0], torch.Generator().manual_seed(0)
    halves = torch.tensor([WIDTH / 2, HEIGHT / 2]).double()
    place = (means[..., :2] * focal / means[..., 2:]) / halves
    pull = torch.randn(place.shape, generator=generator).double()
    (place * pull).sum().backward()
    assert means.grad is not None
    torch.testing.assert_close(image_gradients(means.detach(), means.grad, camera), pull.norm(dim=-1))


def controlled_scene(config: DensityConfig, *, steps: int = 4) -> tuple[DynamicScene, Parameters]:
    """After some steps of a fit of colours with density control, motion and weights being learned."""
    before = moving_cards()
    before = replace(before, shading=no_shading(len(before.static), len(before.moving), FRAMES))
    assert before.shading is not None
    marks = torch.arange(len(before.moving), dtype=torch.uint8).expand(FRAMES, -1) + 110
    before = replace(before, shading=replace(before.shading, moving=marks.contiguous()))
    fit = FitConfig(steps=steps, density=config)
    fit.learn.bases = fit.learn.weights = True
    fit.learning_rates.means = 0.0
    parameters = Parameters(before, fit, 1.0)
    parameters.begin_motion()
    targets = targets_of(before)
    density = Density(config, parameters, steps, 1.0, seed=0)
    for step in range(steps):
        scene, camera = parameters.scene, targets.view.camera.select([step % FRAMES])
        frames = torch.tensor([step % FRAMES])
        snapshot = scene.at(frames)
        density.watch(snapshot)
        rendering = render_snapshot(snapshot, camera, scene.near, "reference")
        loss = rgb(replace(at_frame(scene, 0, targets), frames=frames, rendering=rendering))
        parameters.step(loss)
        density.after(step + 1, snapshot, camera)
    return before, parameters


def test_indices_weights_brightness_and_bases_stay_with_their_gaussians() -> None:
    config = DensityConfig(enabled=True, begin=0.0, end=1.0, every=2, gradient=1e-4, clone_size=10.0, max_size=10.0)
    before, parameters = controlled_scene(config)
    after = parameters.result()
    assert len(after.moving) > len(before.moving)
    assert len(after.static) > len(before.static)
    apart = torch.cdist(after.moving.means, before.moving.means)
    came_from = apart.argmin(1)  # they do not move, and clones stand where their originals do
    assert float(apart.amin(1).max()) < 1e-6
    assert torch.equal(after.indices[0], before.indices[0][came_from])
    assert after.shading is not None
    assert before.shading is not None
    assert torch.equal(after.shading.moving, before.shading.moving[:, came_from])
    assert after.shading.places.shape[0] == len(after.static)
    assert (after.logits[0] - before.logits[0][came_from]).abs().max() < 0.05  # learned, from where they began
    assert not after.logits[0].requires_grad
    everywhere = torch.arange(FRAMES)
    assert after.positions(everywhere).shape[1] == len(after.static) + len(after.moving)


def test_adam_remembers_what_stays_and_nothing_of_what_is_new() -> None:
    config = DensityConfig(enabled=True, begin=0.0, end=1.0, every=4, gradient=1e-4, clone_size=10.0, max_size=10.0)
    _, parameters = controlled_scene(config)
    state = {group["name"]: parameters._adam.state[group["params"][0]] for group in parameters._adam.param_groups}
    for name in ("static.sh", "moving.sh", "weights.0"):
        remembered = state[name]["exp_avg"].flatten(1).abs().sum(1)
        old = {"static.sh": 108, "moving.sh": 32, "weights.0": 32}[name]
        assert len(remembered) > old
        assert bool((remembered[:old] > 0).any())
        assert not bool(remembered[old:].any())


def test_opacities_are_reset_and_the_fit_goes_on() -> None:
    config = DensityConfig(enabled=True, begin=0.0, end=1.0, every=100, reset_every=3)
    _, parameters = controlled_scene(config)
    opacities = parameters.result().moving.opacity_logits.sigmoid()
    assert float(opacities.max()) < 0.12
    assert float(opacities.max()) > 0.09


@pytest.mark.parametrize("enabled", [True, False])
def test_switched_off_nothing_changes(enabled: bool) -> None:
    config = DensityConfig(enabled=enabled, begin=0.0, end=1.0, every=2, gradient=1e-4, max_size=10.0)
    before, parameters = controlled_scene(config)
    assert (len(parameters.result().moving) == len(before.moving)) is not enabled


def test_a_set_may_be_empty() -> None:
    new = round_of(row_of([]), [])
    assert len(new.gaussians) == 0
