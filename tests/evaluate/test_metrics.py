"""Metrics against slow implementations of their own, written from the definitions."""

import math

import numpy as np
import pytest

from lerobot_msdyn.evaluate.metrics import flicker, inside_ssim, masked_psnr_db, partial_ssim, quantised

HEIGHT, WIDTH = 26, 31


def pair(noise: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """A smooth picture, and the same with noise."""
    random = np.random.default_rng(0)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    true = 0.5 + 0.4 * np.stack([np.sin(0.3 * x + 0.2 * y), np.cos(0.25 * y), np.sin(0.15 * x)], axis=-1)
    return quantised(true + noise * random.standard_normal(true.shape)), quantised(true)


def masks() -> dict[str, np.ndarray]:
    random = np.random.default_rng(1)
    half = np.zeros((HEIGHT, WIDTH), bool)
    half[:, : WIDTH // 2] = True
    few = np.zeros_like(half)
    few[3:7, 5:9] = True
    return {
        "full": np.ones_like(half),
        "half": half,
        "few": few,
        "empty": np.zeros_like(half),
        "scattered": random.random(half.shape) < 0.15,
        "weights": random.random(half.shape) * (random.random(half.shape) < 0.5),
    }


def slow_pass(values: np.ndarray, weight: np.ndarray, kernel: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """One partial convolution along the last axis, by the definition, pixel by pixel."""
    count = values.shape[1] - len(kernel) + 1
    out, seen = np.zeros((len(values), count)), np.zeros((len(values), count))
    for i in range(len(values)):
        for j in range(count):
            total = sum(weight[i, j + k] for k in range(len(kernel)))
            if total != 0:
                products = (values[i, j + k] * weight[i, j + k] * tap for k, tap in enumerate(kernel))
                out[i, j], seen[i, j] = sum(products) * len(kernel) / total, 1
    return out, seen


def slow_mssim(rendered: np.ndarray, true: np.ndarray, mask: np.ndarray) -> float:
    """DyCheck's mSSIM from its definition."""
    taps = [math.exp(-0.5 * ((k - 5) / 1.5) ** 2) for k in range(11)]
    kernel = [tap / sum(taps) for tap in taps]

    def mean(values: np.ndarray) -> np.ndarray:
        rows, seen = slow_pass(values, mask.astype(float), kernel)
        return slow_pass(rows.T, seen.T, kernel)[0].T

    terms = []
    for channel in range(3):
        a, b = rendered[..., channel] / 255, true[..., channel] / 255
        ma, mb = mean(a), mean(b)
        va, vb = np.maximum(mean(a * a) - ma**2, 0), np.maximum(mean(b * b) - mb**2, 0)
        cab = mean(a * b) - ma * mb
        cab = np.sign(cab) * np.minimum(np.sqrt(va * vb), np.abs(cab))
        terms.append((2 * ma * mb + 1e-4) * (2 * cab + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    return float(np.mean(terms))


@pytest.mark.parametrize("name", masks())
def test_mssim_is_the_definition_s(name: str) -> None:
    rendered, true = pair()
    mask = masks()[name]
    assert partial_ssim(rendered, true, mask) == pytest.approx(slow_mssim(rendered, true, mask), abs=1e-9)


def test_golden_values_of_mssim() -> None:
    """Printed by `slow_mssim`; what the mask leaves out counts as perfect."""
    rendered, true = pair()
    ssim = {name: round(partial_ssim(rendered, true, mask), 3) for name, mask in masks().items()}
    assert ssim == {"full": 0.625, "half": 0.824, "few": 0.996, "empty": 1.0, "scattered": 0.869, "weights": 0.793}


def test_psnr_is_the_mean_over_the_mask() -> None:
    rendered, true = pair()
    for name, mask in masks().items():
        total = weight = 0.0
        for i, j, c in np.ndindex(rendered.shape):
            total += mask[i, j] * (rendered[i, j, c] / 255 - true[i, j, c] / 255) ** 2
            weight += mask[i, j]
        expected = -10 * math.log10(total / weight) if weight else math.inf
        assert masked_psnr_db(rendered, true, mask) == pytest.approx(expected), name


def test_the_same_picture_is_perfect() -> None:
    _, true = pair()
    full = np.ones(true.shape[:2], bool)
    assert masked_psnr_db(true, true, full) == math.inf
    assert partial_ssim(true, true, full) == pytest.approx(1)
    assert inside_ssim(true, true, full) == pytest.approx(1)


def test_ssim_inside_a_mask_does_not_see_the_rest() -> None:
    rendered, true = pair()
    mask = masks()["half"]
    changed = rendered.copy()
    changed[~mask] = 0
    assert inside_ssim(changed, true, mask) == pytest.approx(inside_ssim(rendered, true, mask))
    assert inside_ssim(rendered, true, mask) < 0.9


def slow_inside_ssim(rendered: np.ndarray, true: np.ndarray, mask: np.ndarray) -> float:
    """Weighted moments over the pixels of the window that are in the mask, at every pixel of the mask."""
    tap = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    inside = np.pad(mask, 5)
    a, b = (np.pad(picture / 255, ((5, 5), (5, 5), (0, 0))) for picture in (rendered, true))
    terms = []
    for i, j in np.argwhere(mask):
        window = np.s_[i : i + 11, j : j + 11]
        weight = (np.outer(tap, tap) * inside[window])[..., None]
        weight = weight / weight.sum()
        ma, mb = (weight * a[window]).sum((0, 1)), (weight * b[window]).sum((0, 1))
        da, db = a[window] - ma, b[window] - mb
        va, vb, cab = (weight * da * da).sum((0, 1)), (weight * db * db).sum((0, 1)), (weight * da * db).sum((0, 1))
        terms.append((2 * ma * mb + 1e-4) * (2 * cab + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    return float(np.mean(terms))


@pytest.mark.parametrize("name", ["full", "half", "few", "scattered"])
def test_ssim_inside_is_the_definition_s(name: str) -> None:
    rendered, true = pair()
    mask = masks()[name]
    assert inside_ssim(rendered, true, mask) == pytest.approx(slow_inside_ssim(rendered, true, mask), abs=1e-9)


def test_pictures_are_truncated_to_8_bits() -> None:
    values = np.array([[[-0.1, 0.999 / 255, 1.7]]])
    assert quantised(values).tolist() == [[[0, 0, 255]]]


def test_flicker_is_what_changes_beyond_the_truth() -> None:
    true = np.zeros((3, 4, 5, 3), np.uint8)
    true[1] = 40  # a true change of brightness is none
    everywhere = np.ones(true.shape[:3], bool)
    assert flicker(true + np.uint8(7), true, everywhere) == 0
    rendered = true.copy()
    rendered[1] += 6
    assert flicker(rendered, true, everywhere) == 6
    rendered[:, 0] = 99
    below = everywhere.copy()
    below[:, 0] = False
    assert flicker(rendered, true, below) == 6
    below[1] = False
    assert math.isnan(flicker(rendered, true, below))
