"""New cameras of an episode: sampled, and shrunk along their own path until enough of what they show was recorded."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.reconstruction.evidence import is_behind
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.views.camera_change import sample_change
from lerobot_msdyn.views.pictures import coverages

FRAMES = 4  # at which coverage is looked at
ROUNDS = 5  # of bisection
SMALLEST = 0.1  # share of a change that is still worth rendering
MIN_CROP = 0.5  # share of the picture's width that a crop keeps at least
CROP_STEPS = 32
STRAY = 0.002  # share of a crop's pixels that may be empty all the same


@dataclass(frozen=True)
class NewCameras:
    """The cameras of one new episode."""

    cameras: dict[str, CameraTrack]  # at the size of the recorded videos
    amounts: dict[str, dict[str, float]]  # camera -> what was sampled, by name
    rejected: str = ""  # why they must not be used


def new_cameras(
    scenes: Mapping[str, Reconstruction],
    recipe: Recipe,
    episode: int,
    variant: int,
    attempt: int = 0,
    other: Float[Tensor, "4 4"] | None = None,
) -> NewCameras:
    """One sample for all cameras of an episode, within `recipe.max_unseen`; a function of the seed and the numbers.

    Arguments as in `sample_change`.

    Raises:
        ConfigError: a given pose is behind what the recorded camera sees, or the pose of another camera is missing.
    """
    perturbation = recipe.perturbation
    change = sample_change(perturbation, scenes, recipe.seed, episode, variant, attempt, other)

    def at(factor: float) -> dict[str, CameraTrack]:
        cameras = change.cameras(factor)
        return _cropped(scenes, cameras) if recipe.crop_to_covered else cameras

    def worst(factor: float) -> float:
        return max(_unseen(scenes[key], camera) for key, camera in at(factor).items())

    if perturbation.refuses_behind and any(is_behind_scene(scenes[key], c) for key, c in change.cameras().items()):
        raise ConfigError(
            f"the pose that perturbation {perturbation.type_name!r} gives for variant {variant} is behind what the "
            f"recorded camera of episode {episode} sees (under the table, say); expected a place in front of it"
        )
    factor = largest_factor(worst, recipe.max_unseen)
    amounts = change.described()
    if factor is None:
        reason = f"more than {100 * recipe.max_unseen:g} % unseen even at {SMALLEST:g} of the change that was sampled"
        return NewCameras(at(SMALLEST), amounts, reason)
    if factor < 1:
        amounts = {key: named | {"shrunk_to": factor} for key, named in amounts.items()}
    return NewCameras(at(factor), amounts)


def largest_factor(unseen_at: Callable[[float], float], bound: float) -> float | None:
    """The largest share of a change at which the unseen share is within the bound, by bisection; None: too small."""
    if unseen_at(1.0) <= bound:
        return 1.0
    if unseen_at(SMALLEST) > bound:
        return None
    low, high = SMALLEST, 1.0
    for _ in range(ROUNDS):
        middle = (low + high) / 2
        low, high = (middle, high) if unseen_at(middle) <= bound else (low, middle)
    return low


def is_behind_scene(scene: Reconstruction, camera: CameraTrack) -> bool:
    """Whether a camera is ever behind what stands before the recorded one."""
    return any(is_behind(window.evidence, camera.world_from_camera[:, :3, 3]) for window in scene.windows)


def _looked_at(scene: Reconstruction, camera: CameraTrack) -> tuple[CameraTrack, Tensor]:
    """Some of a new camera's frames at the size at which the scene was fitted, and their numbers."""
    frames = evenly(len(camera), FRAMES)
    fitted = scene.windows[0].evidence.camera
    return camera.select(frames).resized(fitted.width, fitted.height), frames


def _unseen(scene: Reconstruction, camera: CameraTrack) -> float:
    """The largest unseen share of some frames; 1 for a camera behind the scene."""
    if is_behind_scene(scene, camera):
        return 1.0
    return max(coverage.unseen_share for coverage in coverages(scene, *_looked_at(scene, camera)))


def _cropped(scenes: Mapping[str, Reconstruction], cameras: dict[str, CameraTrack]) -> dict[str, CameraTrack]:
    """The cameras without the empty parts at their borders, by a change of their intrinsics."""
    cropped = {}
    for key, camera in cameras.items():
        empty = [coverage.empty for coverage in coverages(scenes[key], *_looked_at(scenes[key], camera))]
        left, top, size = covered_rectangle(np.any(empty, axis=0))
        intrinsics = camera.intrinsics.clone()
        intrinsics[:, 0, 2] -= left * camera.width
        intrinsics[:, 1, 2] -= top * camera.height
        intrinsics[:, :2] /= size
        cropped[key] = replace(camera, intrinsics=intrinsics)
    return cropped


def covered_rectangle(empty: Bool[ndarray, "h w"]) -> tuple[float, float, float]:
    """Left, top and size (shares of the width, height and both) of a large part of a picture with little that is empty.

    It has the picture's proportions; of those of one size the one nearest the middle. Without any: the whole.
    """
    height, width = empty.shape
    sums = np.pad(empty.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    for size in np.linspace(1, MIN_CROP, CROP_STEPS):
        h, w = round(height * size), round(width * size)
        inside = sums[h:, w:] - sums[:-h, w:] - sums[h:, :-w] + sums[:-h, :-w]
        rows, columns = np.nonzero(inside <= STRAY * h * w)
        if len(rows):
            off = (rows - (height - h) / 2) ** 2 + (columns - (width - w) / 2) ** 2
            best = int(off.argmin())
            return float(columns[best] / width), float(rows[best] / height), float(size)
    return 0.0, 0.0, 1.0
