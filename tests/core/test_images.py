"""The helpers of images: exact where they can be."""

import numpy as np
import pytest

from lerobot_msdyn.core.images import box_about, masked_median, nearest_of


def test_box_has_a_margin_within_the_picture() -> None:
    region = np.zeros((100, 200), bool)
    region[50:60, 5:9] = True
    assert box_about(region) == (slice(34, 76), slice(0, 25))


def test_box_has_its_least_size_where_the_picture_allows() -> None:
    region = np.zeros((100, 200), bool)
    region[50, 198] = True
    rows, columns = box_about(region, 64)
    assert rows.stop - rows.start == 64
    assert rows.start <= 50 < rows.stop
    assert columns == slice(136, 200)
    assert box_about(region, 120)[0] == slice(0, 100)


def test_box_about_nothing_is_empty() -> None:
    assert box_about(np.zeros((10, 10), bool)) == (slice(0, 0), slice(0, 0))


def test_nearest_marked_pixel_by_brute_force() -> None:
    rng = np.random.default_rng(0)
    marked = rng.random((20, 30)) < 0.02
    rows, columns = np.nonzero(marked)
    y, x = np.mgrid[:20, :30]
    distance = np.hypot(y[..., None] - rows, x[..., None] - columns)
    found = nearest_of(marked)
    taken = np.hypot(y - found // 30, x - found % 30)
    assert marked.ravel()[found].all()
    assert (taken <= 1.03 * distance.min(-1)).all()
    assert (found[marked] == np.flatnonzero(marked)).all()
    assert (nearest_of(np.zeros((4, 5), bool)) == 0).all()


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_median_is_over_the_usable_frames(kind: type) -> None:
    rng = np.random.default_rng(0)
    values: np.ndarray = rng.integers(0, 256, (9, 48, 3)).astype(kind)
    usable = rng.random((9, 48)) < 0.5
    usable[:, 0], usable[:, 1] = False, True
    found = masked_median(values, usable[..., None])
    assert (found[0] == 0).all()
    for pixel in range(1, 48):
        np.testing.assert_array_equal(found[pixel], np.median(values[usable[:, pixel], pixel], axis=0))
    alone = rng.random(values.shape) < 0.5
    np.testing.assert_array_equal(masked_median(values, alone)[..., 0], masked_median(values[..., 0], alone[..., 0]))
