"""Chroma of 4:2:0 video at full size: nearer to the picture before it was encoded, where luma has edges."""

import av
import numpy as np
import pytest

from lerobot_msdyn.dataset.chroma import is_subsampled, with_chroma


def subsampled(picture: np.ndarray) -> np.ndarray:
    """What is left of a picture whose chroma is kept at half the size, as FFmpeg converts it."""
    frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
    return frame.reformat(format="yuv420p").to_ndarray(format="rgb24")


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return 10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2))


def restored(picture: np.ndarray) -> np.ndarray:
    return next(with_chroma([picture]))


@pytest.mark.parametrize("size", [(48, 64), (47, 63), (1, 2), (5, 1)])
def test_grey_pictures_stay_as_they_are(size: tuple[int, int]) -> None:
    grey = np.random.default_rng(0).integers(0, 256, size, np.uint8)
    picture = np.repeat(grey[..., None], 3, -1)
    assert np.abs(restored(picture).astype(int) - picture).max() <= 1


def test_one_colour_stays_as_it_is() -> None:
    picture = np.full((16, 16, 3), (200, 40, 90), np.uint8)
    assert np.abs(restored(picture).astype(int) - picture).max() <= 1


def test_an_edge_within_a_block_gets_its_colours_back() -> None:
    picture = np.zeros((32, 32, 3), np.uint8)
    picture[:, :15], picture[:, 15:] = (210, 60, 50), (20, 40, 120)
    left = subsampled(picture)
    assert psnr(restored(left)[:, 8:24], picture[:, 8:24]) > psnr(left[:, 8:24], picture[:, 8:24]) + 3


def test_luma_stays() -> None:
    picture = np.random.default_rng(1).integers(60, 190, (40, 40, 3)).astype(np.uint8)
    weights = np.array([0.299, 0.587, 0.114])
    assert np.abs((restored(picture) - picture.astype(float)) @ weights).max() < 1


def test_only_video_that_says_so() -> None:
    assert is_subsampled("yuv420p")
    assert is_subsampled("yuvj420p")
    assert not is_subsampled("yuv444p")
