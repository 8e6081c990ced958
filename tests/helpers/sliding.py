"""Small textured videos whose every motion is known."""

import cv2
import numpy as np
import torch
from torch import Tensor

FRAMES, HEIGHT, WIDTH = 30, 72, 96


def texture(height: int, width: int, seed: int, mean: tuple[float, float, float]) -> np.ndarray:
    """Smooth random colours [h,w,3] about a mean."""
    noise = np.random.default_rng(seed).normal(size=(height, width, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return np.clip(noise / noise.std() * 25 + np.array(mean, np.float32), 0, 255)


def paste(background: np.ndarray, patch: np.ndarray, x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
    """A patch with its upper left corner at a sub-pixel position; the image, and the mask of the patch."""
    shift = np.array([[1, 0, x], [0, 1, y]], np.float32)
    size = (background.shape[1], background.shape[0])
    cover = cv2.warpAffine(np.ones(patch.shape[:2], np.float32), shift, size)
    moved = cv2.warpAffine(patch, shift, size, borderMode=cv2.BORDER_REPLICATE)
    return background * (1 - cover[..., None]) + moved * cover[..., None], cover > 0.5


class Clip:
    """A block that rests, slides by `speed` px a frame from `start` to `stop`, and rests again."""

    def __init__(self, start: int = 8, stop: int = 20, speed: float = 1.5, noise: float = 1.0) -> None:
        generator = np.random.default_rng(7)
        self.empty = texture(HEIGHT, WIDTH, 0, (90, 120, 90))
        block = texture(20, 24, 1, (190, 90, 60))
        progress = np.clip(np.arange(FRAMES) - start, 0, stop - start)
        self.corner = np.stack((12 + speed * progress, np.full(FRAMES, 24.0)), axis=1)  # px
        pictures = [paste(self.empty, block, x, y) for x, y in self.corner]
        noisy = [np.clip(image + noise * generator.normal(size=image.shape), 0, 255) for image, _ in pictures]
        self.rgb: Tensor = torch.from_numpy(np.stack(noisy).round().astype(np.uint8))
        self.mask: Tensor = torch.from_numpy(np.stack([mask for _, mask in pictures]))
