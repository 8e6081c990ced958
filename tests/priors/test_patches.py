"""Patches: correlation and registration."""

import cv2
import numpy as np
import pytest

from lerobot_msdyn.priors.tracks.patches import cut, register, sample

XY = np.array([[30.5, 20.5], [41.0, 33.0], [52.25, 40.75]], np.float32)


@pytest.fixture
def picture() -> np.ndarray:
    noise = np.random.default_rng(3).normal(size=(64, 80)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return 120 + 40 * smooth / smooth.std()


def shifted(picture: np.ndarray, x: float, y: float) -> np.ndarray:
    return cv2.warpAffine(picture, np.array([[1, 0, x], [0, 1, y]], np.float32), picture.shape[::-1])


ONE_SURFACE = np.ones((64, 80), np.uint8)


def test_registration_finds_a_sub_pixel_shift(picture) -> None:
    patches = cut(picture, ONE_SURFACE, XY)
    found, correlation = register(patches, shifted(picture, 0.75, -0.5), XY)
    np.testing.assert_allclose(found - XY, np.tile([0.75, -0.5], (3, 1)), atol=0.05)
    assert (correlation > 0.98).all()


def test_brightness_and_contrast_do_not_matter(picture) -> None:
    patches = cut(picture, ONE_SURFACE, XY)
    found, correlation = register(patches, 30 + 0.8 * shifted(picture, 0.5, 0.5), XY)
    np.testing.assert_allclose(found - XY, 0.5, atol=0.05)
    assert (correlation > 0.98).all()


def test_what_lies_beyond_an_edge_does_not_count(picture) -> None:
    """The left half of the picture moves one way, the right half the other; the point is 1.5 px from the edge."""
    labels = ONE_SURFACE.copy()
    labels[:, 40:] = 2
    point = np.array([[38.5, 30.5]], np.float32)
    moved = np.where(np.arange(80) < 41, shifted(picture, 1.0, 0.0), shifted(picture, -1.0, 0.0)).astype(np.float32)
    found, correlation = register(cut(picture, labels, point), moved, point)
    np.testing.assert_allclose(found, [[39.5, 30.5]], atol=0.15)
    _, careless = register(cut(picture, ONE_SURFACE, point), moved, point)
    assert correlation[0] > careless[0]


def test_without_texture_a_point_stays_where_it_was_expected() -> None:
    flat = np.full((64, 80), 100, np.float32)
    found, correlation = register(cut(flat, ONE_SURFACE, XY), flat, XY + 0.4)
    np.testing.assert_allclose(found, XY + 0.4)
    np.testing.assert_allclose(correlation, 1)


def test_another_picture_does_not_correlate(picture) -> None:
    other = picture[::-1, ::-1].copy()
    _, correlation = register(cut(picture, ONE_SURFACE, XY), other, XY)
    assert (correlation < 0.7).all()


def test_sampling_is_at_half_integer_centres(picture) -> None:
    values = sample(picture[..., None], np.array([[10.5, 20.5], [11.0, 20.5]], np.float32))
    np.testing.assert_allclose(values[:, 0], [picture[20, 10], (picture[20, 10] + picture[20, 11]) / 2], rtol=1e-4)
    assert sample(picture[..., None], np.zeros((0, 2), np.float32)).shape == (0, 1)
