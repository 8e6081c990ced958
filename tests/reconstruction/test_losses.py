"""Loss terms against values worked out by hand."""

import numpy as np
import pytest
import torch
from jaxtyping import Float
from still_video import grey_scene, still_video
from torch import Tensor

from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.core.cli import parse_config
from lerobot_msdyn.core.config import FitConfig
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.registries import LOSSES
from lerobot_msdyn.reconstruction.fit import fit
from lerobot_msdyn.reconstruction.loss_terms import FitStep, certain_pixels
from lerobot_msdyn.reconstruction.losses.depth import depth_loss
from lerobot_msdyn.reconstruction.losses.mask import mask_loss
from lerobot_msdyn.reconstruction.losses.rgb import rgb_loss


def test_rgb_is_the_mean_absolute_difference() -> None:
    drawn, recorded = torch.full((1, 2, 2, 3), 0.5), torch.full((1, 2, 2, 3), 0.25)
    recorded[0, 0, 0] = 0.5
    assert float(rgb_loss(drawn, recorded)) == pytest.approx(0.25 * 3 / 4)


def test_depth_compares_inverse_depth_where_known_and_drawn() -> None:
    known = torch.tensor([[[1.0, 2.0, 0.0, 1.0]]])
    drawn = torch.tensor([[[2.0, 2.0, 9.0, 9.0]]])
    alpha = torch.tensor([[[1.0, 1.0, 1.0, 0.1]]])
    # |1/2 - 1| and |1/2 - 1/2|, mean 0.25, over the mean inverse depth (1 + 1/2) / 2.
    assert float(depth_loss(drawn, known, alpha)) == pytest.approx(0.25 / 0.75)


def test_depth_of_nothing_known_is_zero_with_a_gradient() -> None:
    drawn = torch.ones(1, 2, 2, requires_grad=True)
    loss = depth_loss(drawn, torch.zeros(1, 2, 2), torch.ones(1, 2, 2))
    loss.backward()
    assert float(loss.detach()) == 0
    assert drawn.grad is not None
    assert not drawn.grad.any()


def test_mask_counts_only_certain_pixels() -> None:
    moving = torch.tensor([[[True, True, False, False]]])
    drawn = torch.tensor([[[1.0, 0.0, 1.0, 0.5]]])
    certain = torch.tensor([[[True, False, False, True]]])
    assert float(mask_loss(drawn, moving, certain)) == pytest.approx(0.25)


def test_certain_pixels_leave_out_a_band_at_the_border() -> None:
    moving = torch.zeros(1, 1, 9, dtype=torch.bool)
    moving[..., 5:] = True
    assert certain_pixels(moving, np.ones((3, 3), np.uint8))[0, 0].tolist() == [True] * 4 + [False] * 2 + [True] * 3


def test_a_term_of_ones_own_sees_the_scene_and_is_minimised(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[FitStep] = []

    def small(step: FitStep) -> Float[Tensor, ""]:
        seen.append(step)
        return step.scene.static.log_scales.exp().mean()

    monkeypatch.setitem(LOSSES._registered, "small", small)
    view, priors = still_video()
    config = FitConfig(steps=6, weights={"small": 10.0})
    scene = grey_scene(view)
    result = fit(scene, view, priors, config, empty=view.rgb[0], distance=1.0, seed=0)
    assert result.scene.static.log_scales.mean() < scene.static.log_scales.mean() - 0.01
    assert torch.equal(result.scene.static.sh, scene.static.sh), "no other term is in use"
    assert set(result.losses) == {"small"}
    assert seen[0].targets.priors.instances.shape == view.rgb.shape[:3]
    assert seen[0].rendering.rgb.requires_grad


def test_a_term_that_is_not_there_is_refused_before_anything_is_done() -> None:
    with pytest.raises(
        ConfigError, match=r"fit.weights.sharp is unknown; expected one of depth, mask, rgb, rigidity, ssim, track"
    ):
        parse_config(AugmentConfig, ["--fit.weights.sharp", "0.1"], {}, command="augment")
    with pytest.raises(ConfigError, match=r"fit.weights.rgb is -1"):
        parse_config(AugmentConfig, ["--fit.weights.rgb", "-1"], {}, command="augment")
    assert parse_config(AugmentConfig, ["--fit.weights.rgb", "0.5"], {}, command="augment").fit.weights == {
        "rgb": 0.5,
        "depth": 0.1,
        "mask": 0.1,
    }
