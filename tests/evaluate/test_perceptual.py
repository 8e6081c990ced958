"""FLIP and mLPIPS: what they must say of pictures whose difference is known, and what is said where they are absent."""

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_msdyn.evaluate import perceptual
from lerobot_msdyn.evaluate.perceptual import masked_flip, masked_lpips, without_flip, without_lpips


def pair(noise: float) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    true = np.repeat(np.linspace(40, 200, 64)[None, :, None], 48, axis=0) + np.zeros(3)
    return (true + noise * random.standard_normal(true.shape)).clip(0, 255).astype(np.uint8), true.astype(np.uint8)


def test_flip_grows_with_the_difference_and_keeps_to_the_mask() -> None:
    pytest.importorskip("flip_evaluator")
    full = np.ones((48, 64), bool)
    values = [masked_flip(*pair(noise), full) for noise in (0, 8, 30)]
    assert values[0] == 0
    assert 0 < values[1] < values[2] < 1
    rendered, true = pair(0)
    rendered = rendered.copy()
    rendered[:, :20] = 255
    left = np.zeros_like(full)
    left[:, :20] = True
    far = np.zeros_like(full)
    far[:, 40:] = True
    assert masked_flip(rendered, true, left) > 0.3
    assert masked_flip(rendered, true, far) < 1e-3


def test_flip_of_black_and_white() -> None:
    """The largest difference there is: 1 where no feature adds to it (Andersson et al. 2020, section 5)."""
    pytest.importorskip("flip_evaluator")
    black, white = np.zeros((32, 32, 3), np.uint8), np.full((32, 32, 3), 255, np.uint8)
    assert masked_flip(black, white, np.ones((32, 32), bool)) == pytest.approx(0.97, abs=0.03)


def test_mlpips_is_the_mean_of_the_map_over_the_mask() -> None:
    seen: list[torch.Tensor] = []

    def network(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        seen.extend((one, other))
        return (one - other).abs().sum(1, keepdim=True)

    rendered, true = np.full((4, 5, 3), 255, np.uint8), np.zeros((4, 5, 3), np.uint8)
    mask = np.zeros((4, 5), bool)
    mask[0] = True
    assert masked_lpips(rendered, true, mask, network) == 6
    assert seen[0].unique().tolist() == [-1, 1]
    assert seen[1].unique().tolist() == [-1]
    assert masked_lpips(rendered, true, ~mask & mask, network) == 0


@pytest.mark.slow
def test_mlpips_of_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a random backbone: nothing for the same picture, more for the more different one."""
    lpips = pytest.importorskip("lpips")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        network = lpips.LPIPS(net="alex", spatial=True, pnet_rand=True, verbose=False)
    full = np.ones((48, 64), bool)
    values = [masked_lpips(*pair(noise), full, network) for noise in (0, 8, 60)]
    assert values[0] == 0
    assert 0 < values[1] < values[2]


def test_what_is_absent_is_said_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    if perceptual.has_library("lpips"):
        from torchvision.models import AlexNet_Weights

        assert AlexNet_Weights.IMAGENET1K_V1.url.endswith(f"/{perceptual.ALEXNET}")
        assert f"AlexNet's weights are not in {tmp_path}" in without_lpips()
        (tmp_path / "checkpoints").mkdir()
        (tmp_path / "checkpoints" / perceptual.ALEXNET).touch()
        assert without_lpips() == ""
    for module in ("lpips", "flip_evaluator"):
        monkeypatch.setitem(sys.modules, module, None)
    assert "lpips is not installed; pip install 'lerobot_msdyn[evaluate]'" in without_lpips()
    assert "flip-evaluator is not installed" in without_flip()
