"""The SIMD operations against numpy, one lane at a time."""

import numba
import numpy as np
import pytest

from lerobot_msdyn.render.cpu import planes, simd
from lerobot_msdyn.render.cpu.simd import LANES

VALUES = np.linspace(-3, 4, LANES).astype(np.float32)


@numba.njit
def _exp2(values, out):
    for start in range(0, values.size, LANES):
        simd.store(out, start, simd.exp2(simd.load(values, start)))


def test_exp2_is_accurate_over_its_range():
    exponents = np.linspace(-125, 126, 4096 * LANES).astype(np.float32)
    got = np.empty_like(exponents)
    _exp2(exponents, got)
    expected = np.exp2(exponents.astype(np.float64))
    assert np.abs(got / expected - 1).max() < 2.5e-7


def test_exp2_does_not_underflow_into_garbage():
    exponents = np.full(LANES, -1000, np.float32)
    got = np.empty_like(exponents)
    _exp2(exponents, got)
    np.testing.assert_allclose(got, 2.0**-126, rtol=1e-6)


@numba.njit
def _mixed(a, b, out):
    x, y = simd.load(a, 0), simd.load(b, 0)
    simd.store(out, 0, x + y)
    simd.store(out, LANES, x - y)
    simd.store(out, 2 * LANES, x * y)
    simd.store(out, 3 * LANES, x / y)
    simd.store(out, 4 * LANES, simd.fma(x, y, x))
    simd.store(out, 5 * LANES, simd.fnma(x, y, x))
    simd.store(out, 6 * LANES, simd.smaller(x, y))
    simd.store(out, 7 * LANES, simd.larger(x, y))
    simd.store(out, 8 * LANES, simd.floor(x))
    simd.store(out, 9 * LANES, simd.ceil(x))
    simd.store(out, 10 * LANES, simd.magnitude(x))
    simd.store(out, 11 * LANES, simd.set_sign(simd.magnitude(x), simd.less(x, y)))
    simd.store(out, 12 * LANES, simd.select(simd.greater_equal(x, y), x, simd.zeros()))


def test_arithmetic_and_selection():
    a, b = VALUES, np.roll(VALUES, 3) + np.float32(0.25)
    out = np.empty((13, LANES), np.float32)
    _mixed(a, b, out.reshape(-1))
    signed = np.where(a < b, -np.abs(a), np.abs(a))
    expected = [
        a + b, a - b, a * b, a / b, a * b + a, a - a * b, np.minimum(a, b), np.maximum(a, b), np.floor(a), np.ceil(a),
        np.abs(a), signed, np.where(a >= b, a, 0),
    ]  # fmt: skip
    np.testing.assert_allclose(out, expected, rtol=1e-6, atol=1e-6)


@numba.njit
def _blocks(image, stride, out, copy):
    block = simd.load_block(image, 2 * stride + 3, stride)
    simd.store(out, 0, block)
    simd.store_block(copy, 2 * stride + 3, stride, block)


def test_blocks_of_an_image():
    image = np.arange(12 * 10, dtype=np.float32)
    copy, out = np.zeros_like(image), np.empty(LANES, np.float32)
    _blocks(image, 10, out, copy)
    window = (slice(2, 2 + simd.BLOCK_HEIGHT), slice(3, 3 + simd.BLOCK_WIDTH))
    expected = np.zeros((12, 10), np.float32)
    expected[window] = image.reshape(12, 10)[window]
    np.testing.assert_array_equal(out, expected[window].reshape(-1))
    np.testing.assert_array_equal(copy.reshape(12, 10), expected)


@numba.njit
def _sums(values, layout, out):
    moments = (
        simd.load(values, 0), simd.load(values, LANES), simd.load(values, 2 * LANES),
        simd.load(values, 3 * LANES), simd.load(values, 4 * LANES), simd.load(values, 5 * LANES),
    )  # fmt: skip
    planes.store_lane_sums(out, 0, moments, planes.load_planes(values, 6 * LANES, layout))


@pytest.mark.parametrize("count", planes.SIZES)
def test_sums_over_lanes_are_stored_in_order(count):
    layout = planes.Layout(count)
    values = np.random.default_rng(0).normal(size=(6 + count, LANES)).astype(np.float32)
    out = np.full(layout.sums, np.nan, np.float32)
    _sums(values.reshape(-1), layout, out)
    np.testing.assert_allclose(out[: 6 + count], values.sum(1), rtol=1e-5, atol=1e-5)
    assert (out[6 + count :] == 0).all()


def test_layouts_hold_the_channels_and_depth():
    assert [planes.layout_for(channels).planes for channels in range(17)] == [4] * 4 + [8] * 4 + [12] * 4 + [17] * 5
