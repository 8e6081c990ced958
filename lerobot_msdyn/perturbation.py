"""Camera changes: one draw per new episode, a function of (seed, episode, variant)."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.cameras import CameraTrack
from lerobot_msdyn.config import JitterConfig, OrbitConfig, PerturbationConfig
from lerobot_msdyn.errors import ConfigError
from lerobot_msdyn.geometry import axis_angle_to_matrix, se3


def draw_rng(seed: int, episode: int, variant: int, attempt: int = 0) -> np.random.Generator:
    """The random numbers of one new episode, the same whatever else is computed before or beside it."""
    return np.random.default_rng([seed, episode, variant] + [attempt] * (attempt > 0))


def look_at_distance(depth: Float[Tensor, "h w"]) -> float:
    """Distance (m) to what the camera looks at: the median known depth of the middle of the image."""
    h, w = depth.shape
    middle = depth[h // 4 : h - h // 4, w // 4 : w - w // 4]
    known = middle[middle > 0]
    if known.numel() == 0:
        known = depth[depth > 0]
    return float(known.median()) if known.numel() else 1.0


def draw_offset(
    config: PerturbationConfig, distance: float, rng: np.random.Generator
) -> tuple[Float[Tensor, "4 4"], dict[str, float]]:
    """One random camera change as (recorded camera from new camera), and what was drawn.

    Args:
        config: the kind of change and its range.
        distance: distance to the look-at point on the optical axis, m.
        rng: from `draw_rng`.
    """
    if isinstance(config, OrbitConfig):
        azimuth = rng.uniform(-config.azimuth_deg, config.azimuth_deg)
        elevation = rng.uniform(-config.elevation_deg, config.elevation_deg)
        shift = rng.uniform(-1, 1, 3) * config.translation_rel * distance
        offset = orbit_offset(azimuth, elevation, distance)
        offset[:3, 3] += torch.from_numpy(shift).float()
        drawn = {"azimuth_deg": azimuth, "elevation_deg": elevation}
    elif isinstance(config, JitterConfig):
        turn = np.radians(rng.normal(0, 1, 3) * config.rotation_deg)
        shift = rng.normal(0, 1, 3) * config.translation_rel * distance
        offset = se3(axis_angle_to_matrix(torch.from_numpy(turn).float()), torch.from_numpy(shift).float())
        drawn = {f"turn_{axis}_deg": float(value) for axis, value in zip("xyz", np.degrees(turn), strict=True)}
    else:
        raise ConfigError(f"no such perturbation: {type(config).__name__}")
    return offset, drawn | {f"shift_{axis}_m": float(value) for axis, value in zip("xyz", shift, strict=True)}


def orbit_offset(azimuth_deg: float, elevation_deg: float, distance: float) -> Float[Tensor, "4 4"]:
    """A camera moved on a sphere about the point at `distance` on its optical axis, still looking at it.

    Positive azimuth moves the camera to its right, positive elevation up; the result maps the new camera's
    coordinates to the recorded camera's.
    """
    # The camera's y axis points down: turning the camera to its right about the point is a negative turn about it.
    azimuth = axis_angle_to_matrix(torch.tensor([0.0, -math.radians(azimuth_deg), 0.0]))
    elevation = axis_angle_to_matrix(torch.tensor([-math.radians(elevation_deg), 0.0, 0.0]))
    rotation = azimuth @ elevation
    target = torch.tensor([0.0, 0.0, distance])
    return se3(rotation, target - rotation @ target)


def perturb(camera: CameraTrack, offset: Float[Tensor, "4 4"]) -> CameraTrack:
    """The camera with the same change, in its own axes, at every frame."""
    return CameraTrack(camera.intrinsics, camera.world_from_camera @ offset, camera.width, camera.height)
