"""The optimisation: it gets closer, it is repeatable, and it leaves its input alone."""

import dataclasses

import pytest
import torch
from motion_levels import of_bases
from moving_cards import in_single, moving_cards, recorded_in_single
from still_video import FRAMES, grey_scene, still_video

from lerobot_msdyn.core.cli import parse_config
from lerobot_msdyn.core.config import FitConfig, LearningRates, Recipe
from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.motion.model.bases import identity_level
from lerobot_msdyn.reconstruction.fit import FitResult, fit, psnr
from lerobot_msdyn.scene.dynamic import DynamicScene


def run(steps: int, seed: int = 0) -> tuple[DynamicScene, FitResult]:
    view, priors = still_video()
    scene = grey_scene(view)
    config = FitConfig(steps=steps)
    config.learning_rates.colours = 0.1
    return scene, fit(scene, view, priors, config, empty=view.rgb[0], distance=1.0, seed=seed)


def test_the_fit_gets_closer_to_the_recorded_pictures() -> None:
    view, _ = still_video()
    before, result = run(40)
    assert result.train_psnr_db > psnr(before, view, torch.arange(FRAMES)) + 6
    assert set(result.losses) == {"rgb", "depth", "mask"}
    assert result.losses["depth"] < 0.05


def test_the_scene_that_was_given_is_not_changed() -> None:
    view, _ = still_video()
    before, result = run(3)
    expected = grey_scene(view)
    for item in dataclasses.fields(expected.static):
        assert torch.equal(getattr(before.static, item.name), getattr(expected.static, item.name))
    assert not torch.equal(result.scene.static.sh, before.static.sh)
    assert not result.scene.static.sh.requires_grad
    assert result.scene.levels is before.levels


def test_levels_as_one_are_fitted_alike() -> None:
    scene, (view, priors) = in_single(moving_cards()), recorded_in_single(moving_cards())
    flags = [
        "--fit.steps",
        "6",
        "--fit.moving_gain_from",
        "1",
        "--fit.weights.track",
        "1",
        "--fit.weights.rigidity",
        "1",
    ]
    config = parse_config(Recipe, flags, {}, command="fit").fit
    apart, as_one = (
        fit(each, view, priors, config, empty=view.rgb[0], distance=1.0, seed=0).scene.decomposed().tensors()
        for each in (scene, scene.composed())
    )
    changed = apart["moving.means"] - scene.tensors()["moving.means"]
    assert changed.abs().mean() > 1e-3
    for name, values in apart.items():  # Adam's first steps have a size that gradients near zero give their sign alone
        assert (as_one[name].float() - values.float()).abs().mean() < 1e-3, name


def test_motion_is_learned_where_its_tensors_are_given() -> None:
    view, priors = still_video()
    scene = grey_scene(view)
    (level,) = of_bases(scene.levels)
    shift = level.displacements.clone().requires_grad_()
    before = shift.detach().clone()
    count = len(scene.static)
    scene = dataclasses.replace(
        scene,
        moving=scene.static,
        levels=(dataclasses.replace(level, displacements=shift),),
        indices=(torch.zeros(count, 1, dtype=torch.long),),
        logits=(torch.zeros(count, 1),),
    )
    learned = [{"params": [shift], "lr": 1e-3}]
    result = fit(scene, view, priors, FitConfig(steps=3), empty=view.rgb[0], distance=1.0, seed=0, learned=learned)
    assert result.scene.levels is scene.levels
    assert not torch.equal(shift, before)


@pytest.mark.parametrize(
    "flags",
    [
        ["--fit.learn.bases", "true", "--fit.learn.begin", "0"],
        ["--fit.learn.weights", "true", "--fit.learn.begin", "0"],
        ["--fit.learn.bases", "true", "--fit.learn.begin", "0", "--fit.learn.sure_px", "3"],
        ["--fit.weights.track", "1"],
        ["--fit.weights.rigidity", "1"],
        ["--fit.weights.ssim", "0.2"],
        ["--fit.density.enabled", "true", "--fit.density.every", "2", "--fit.density.gradient", "1e-5"],
        ["--recipe", "paper"],
    ],
    ids=lambda flags: " ".join(flags[:2]),
)
def test_each_part_of_the_papers_fit_is_one_switch_away_and_changes_the_result(flags: list[str]) -> None:
    double = moving_cards()
    scene, (view, priors) = in_single(double), recorded_in_single(double)
    common = ["--fit.steps", "4", "--fit.held_out_frames", "0"]
    with_it, without = (
        fit(
            scene,
            view,
            priors,
            parse_config(Recipe, [*some, *common], {}, command="fit").fit,
            empty=view.rgb[0],
            distance=1.0,
            seed=0,
        ).scene.tensors()
        for some in (flags, [])
    )
    assert any(
        tensor.shape != without[name].shape or not torch.equal(tensor, without[name])
        for name, tensor in with_it.items()
    )
    assert all(bool(tensor.float().isfinite().all()) for tensor in with_it.values())
    assert torch.equal(without["levels.0.displacements"], of_bases(scene.levels)[0].displacements)
    assert torch.equal(without["levels.0.logits"], scene.logits[0])


def test_same_seed_same_result() -> None:
    assert torch.equal(run(5)[1].scene.static.sh, run(5)[1].scene.static.sh)


def test_no_steps_at_all() -> None:
    before, result = run(0)
    assert torch.equal(result.scene.static.sh, before.static.sh)
    assert result.losses == {}


def test_progress_is_reported_step_by_step() -> None:
    view, priors = still_video()
    seen: list[int] = []
    fit(
        grey_scene(view),
        view,
        priors,
        FitConfig(steps=4),
        empty=view.rgb[0],
        distance=1.0,
        seed=0,
        progress=seen.append,
    )
    assert seen == [1, 1, 1, 1]


def test_a_weight_of_zero_switches_a_term_off() -> None:
    view, priors = still_video()
    config = FitConfig(steps=5)
    config.weights = {"rgb": 0.0, "depth": 0.0, "mask": 0.0}
    scene = grey_scene(view)
    result = fit(scene, view, priors, config, empty=view.rgb[0], distance=1.0, seed=0)
    assert torch.equal(result.scene.static.sh, scene.static.sh)


@pytest.mark.parametrize("gone", ["depth", "frames"])
def test_unknown_depth_is_no_obstacle(gone: str) -> None:
    view, priors = still_video()
    depth = torch.zeros_like(priors.depth) if gone == "depth" else priors.depth.index_fill(0, torch.tensor([1]), 0.0)
    result = fit(
        grey_scene(view),
        view,
        dataclasses.replace(priors, depth=depth),
        FitConfig(steps=3),
        empty=view.rgb[0],
        distance=1.0,
        seed=0,
    )
    assert torch.isfinite(result.scene.static.means).all()


def test_the_fit_stops_when_held_out_frames_no_longer_improve() -> None:
    view, priors = still_video()
    many = dataclasses.replace(view, rgb=view.rgb[:1].expand(12, -1, -1, -1), camera=view.camera.select([0] * 12))
    known = dataclasses.replace(
        priors, depth=priors.depth[:1].expand(12, -1, -1), instances=priors.instances[:1].expand(12, -1, -1)
    )
    config = FitConfig(steps=400, held_out_frames=1, patience=50)
    scene = dataclasses.replace(grey_scene(view), frames=12, levels=(identity_level(torch.zeros(1, 3), 12),))
    config.learning_rates = LearningRates(0.0, 0.0, 0.0, 0.0, 0.0)  # nothing ever improves
    seen: list[int] = []
    result = fit(scene, many, known, config, empty=view.rgb[0], distance=1.0, seed=0, progress=seen.append)
    assert result.steps == 100
    assert sum(seen) == 400


def test_numbers_that_are_not_finite_end_the_fit() -> None:
    view, priors = still_video()
    scene = grey_scene(view)
    config = FitConfig(steps=3)
    config.weights["rgb"] = float("inf")
    with pytest.raises(EpisodeError, match="diverged at step 0, frame"):
        fit(scene, view, priors, config, empty=view.rgb[0], distance=1.0, seed=0)
