"""Where steps look only near what moves, they see there what a look at the whole picture sees."""

from dataclasses import replace

import pytest
import torch
from moving_cards import FRAMES, in_single, moving_cards, recorded_in_single

from lerobot_msdyn.core.config import DensityConfig, FitConfig, LearnConfig
from lerobot_msdyn.core.observations import DepthTraits
from lerobot_msdyn.reconstruction import focus as focus_module
from lerobot_msdyn.reconstruction.fit import fit
from lerobot_msdyn.reconstruction.focus import Focus
from lerobot_msdyn.scene.rendering import render_scene

ROUGH = DepthTraits(assumed=True)


@pytest.mark.parametrize("frame", range(FRAMES))
def test_the_pixels_that_are_compared_are_those_of_the_whole_picture(
    frame: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(focus_module, "AROUND_PX", 27)  # two pixels of these pictures
    scene = in_single(moving_cards())
    scene = replace(scene, static=replace(scene.static, log_scales=scene.static.log_scales - 1.5))  # small ones
    view, priors = recorded_in_single(moving_cards())
    corner = torch.zeros_like(priors.instances)
    corner[:, :4, :4] = 1
    focus = Focus(scene, view, replace(priors, instances=corner), scene.device)
    look = focus(scene, frame)
    part, crop = look.scene, (slice(None), look.rows, look.columns)
    where = torch.zeros(1, view.camera.height, view.camera.width, dtype=torch.bool)
    where[crop] = look.where
    assert bool(where[0, :4, :4].all()), "what the masks say moves"
    camera, when = view.camera.select([frame]), torch.tensor([frame])
    whole = render_scene(scene, camera, when)
    assert bool(where[whole.moving > 0.5].all()), "what moves by its motion"
    for axis in (1, 2):
        assert look.where.any(axis)[0, [0, -1]].all(), "no row or column more is rendered"
    assert 0 < len(part.static) < len(scene.static)
    assert not where.all()
    seen = render_scene(part, camera.cropped(look.rows, look.columns), when)
    torch.testing.assert_close(seen.rgb[look.where], whole.rgb[where], atol=1e-5, rtol=0)
    torch.testing.assert_close(seen.depth[look.where], whole.depth[where], atol=1e-4, rtol=0)


def test_what_stands_still_is_left_alone_and_what_moves_is_not() -> None:
    scene = in_single(moving_cards())
    view, priors = recorded_in_single(moving_cards())
    look = Focus(scene, view, priors, scene.device)(replace(scene, static=_with_gradients(scene.static)), 1)
    assert not look.scene.static.means.requires_grad
    one = FitConfig(steps=1, whole_every=10**6, held_out_frames=0, shadows=False, moving_gain_from=1.0)

    def fitted(settings: FitConfig):
        return fit(
            scene, view, replace(priors, depth_traits=ROUGH), settings, empty=view.rgb[0], distance=1.0, seed=0
        ).scene

    often, once = fitted(replace(one, steps=4)), fitted(one)
    assert (often.static.sh - once.static.sh).abs().max() == 0, "only the first step is a look at the whole"
    assert (often.moving.sh - once.moving.sh).abs().max() > 1e-3


def test_frames_at_which_nothing_is_seen_to_move_change_nothing() -> None:
    scene = in_single(moving_cards())
    view, priors = recorded_in_single(moving_cards())
    nothing = replace(priors, instances=torch.zeros_like(priors.instances), depth_traits=ROUGH)
    aside = replace(scene, moving=replace(scene.moving, means=scene.moving.means + torch.tensor([50.0, 0.0, 0.0])))
    look = Focus(aside, view, nothing, scene.device)(aside, 1)
    assert not look.where.any()
    one = FitConfig(steps=1, whole_every=10**6, held_out_frames=0, shadows=False, moving_gain_from=1.0)
    once, often = (
        fit(aside, view, nothing, settings, empty=view.rgb[0], distance=1.0, seed=0).scene
        for settings in (one, replace(one, steps=3))
    )
    assert torch.equal(once.moving.means, often.moving.means)


@pytest.mark.parametrize(
    "settings",
    [
        FitConfig(whole_every=1),
        FitConfig(learn=LearnConfig(bases=True)),
        FitConfig(density=DensityConfig(enabled=True)),
        FitConfig(weights={"rgb": 1.0, "ssim": 0.2}),
    ],
)
def test_fits_that_need_whole_pictures_look_at_them(settings: FitConfig) -> None:
    view, recorded = recorded_in_single(moving_cards())
    priors = replace(recorded, depth_traits=ROUGH)
    assert Focus.wanted(FitConfig(), view, priors)
    assert not Focus.wanted(FitConfig(), view, replace(recorded, depth_traits=DepthTraits(sharp=True)))
    assert not Focus.wanted(settings, view, priors)
    swaying = view.camera.world_from_camera.clone()
    swaying[1, 0, 3] = 0.01
    moved = replace(view, camera=replace(view.camera, world_from_camera=swaying))
    assert not Focus.wanted(FitConfig(), moved, priors)


def _with_gradients(gaussians):
    return replace(gaussians, means=gaussians.means.clone().requires_grad_())
