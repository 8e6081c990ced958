"""FLIP and mLPIPS: what they must say of pictures whose difference is known, and what is said where they are absent."""

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.evaluate import perceptual
from lerobot_msdyn.evaluate.asked import check_weights
from lerobot_msdyn.evaluate.perceptual import lpips_network, masked_flip, masked_lpips, without_flip, without_lpips


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


@pytest.fixture
def alexnet(monkeypatch: pytest.MonkeyPatch) -> dict[str, torch.Tensor]:
    """Weights of AlexNet's convolutions as torchvision names them."""
    generator = torch.Generator().manual_seed(0)
    state = {}
    for name, shape in perceptual._SHAPES.items():
        state[f"features.{name}"] = 0.02 * torch.randn(shape, generator=generator)
        state[f"features.{name.replace('weight', 'bias')}"] = torch.zeros(shape[0])
    return state


def as_of_lpips(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    slices = {"0": 1, "3": 2, "6": 3, "8": 4, "10": 5}
    return {name.replace("features", f"slice{slices[name.split('.')[1]]}"): value for name, value in state.items()}


@pytest.mark.slow
def test_both_forms_of_weights_give_the_same_distance(alexnet, tmp_path: Path) -> None:
    pytest.importorskip("lpips")
    files = tmp_path / "alexnet.pth", tmp_path / "lpips.pt"
    torch.save(alexnet | {"classifier.1.weight": torch.zeros(3)}, files[0])
    torch.save(as_of_lpips(alexnet), files[1])
    full = np.ones((48, 64), bool)
    one, other = (masked_lpips(*pair(30), full, lpips_network(file)) for file in files)
    assert one == other > 0
    alexnet["features.0.weight"] = alexnet["features.0.weight"].flip(0) ** 3
    torch.save(alexnet, files[0])
    assert masked_lpips(*pair(30), full, lpips_network(files[0])) != one


def test_a_file_of_something_else_is_named_in_a_line(alexnet, tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self):
            return (print, ("run",))

    path = tmp_path / "weights.pt"
    wrong: list[object] = [
        {},
        [1, 2],
        {**alexnet, "features.0.weight": torch.zeros(64, 3, 3, 3)},
        {name: value for name, value in alexnet.items() if "10" not in name},
        Evil(),
    ]
    for content in wrong:
        torch.save(content, path)
        with pytest.raises(
            ConfigError, match=r"lpips_weights: .*weights\.pt (holds no AlexNet|cannot be read)"
        ) as caught:
            lpips_network(path)
        assert "\n" not in str(caught.value)


def test_an_absent_file_is_named_before_the_fit_in_the_same_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "absent.pt"
    with pytest.raises(ConfigError, match=r"absent\.pt cannot be read") as late:
        lpips_network(path)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    with pytest.raises(ConfigError) as early:
        check_weights(path)
    assert str(early.value) == str(late.value)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    check_weights(path)  # nobody will read it


@pytest.mark.slow
def test_real_weights_tell_a_small_difference_from_a_large_one(shared_data: Path) -> None:
    pytest.importorskip("lpips")
    network = lpips_network(shared_data / "models" / "lpips_alexnet_features.pt")
    full = np.ones((48, 64), bool)
    values = [masked_lpips(*pair(noise), full, network) for noise in (0, 4, 60)]
    assert values[0] == 0
    assert 2 * values[1] < values[2]


def test_what_is_absent_is_said_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    if perceptual.has_library("lpips"):
        assert f"AlexNet's weights are not in {tmp_path}" in without_lpips()
        assert "fetch them with: python -m lerobot_msdyn.models fetch alexnet, or make a file" in without_lpips()
        assert without_lpips(tmp_path / "mine.pt") == ""
        (tmp_path / "checkpoints").mkdir()
        (tmp_path / "checkpoints" / perceptual.ALEXNET.file).touch()
        assert without_lpips() == ""
    for module in ("lpips", "flip_evaluator"):
        monkeypatch.setitem(sys.modules, module, None)
    assert "lpips is not installed; pip install 'lerobot_msdyn[evaluate]'" in without_lpips()
    assert "flip-evaluator is not installed" in without_flip()
