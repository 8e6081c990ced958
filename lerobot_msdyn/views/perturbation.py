"""Camera changes: nine amounts per frame, drawn as a function of (seed, episode, variant), and the cameras they give.

Every kind of change is a range for each of the amounts `AMOUNTS`. No amount is no change, so that a change can be
shrunk along its own path by a factor.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.quasirandom import SobolEngine

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import (
    DollyConfig,
    DriftConfig,
    FocalConfig,
    JitterConfig,
    OrbitConfig,
    OtherCameraConfig,
    PerturbationConfig,
    PosesConfig,
    RotationConfig,
    TranslationConfig,
)
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, invert_se3, matrix_to_axis_angle, se3

AMOUNTS = (
    "azimuth_deg",
    "elevation_deg",
    *("shift_x", "shift_y", "shift_z"),  # m
    *("turn_x_deg", "turn_y_deg", "turn_z_deg"),
    "log_zoom",
)
SHIFT, TURN = slice(2, 5), slice(5, 8)
OF_THE_RIG = (OrbitConfig, TranslationConfig, DriftConfig)  # moves all calibrated cameras as one body
LARGEST_NORMAL = 3.0  # standard deviations


@dataclass(frozen=True)
class Viewpoint:
    """A recorded camera and what it looks at."""

    camera: CameraTrack
    distance: float  # m, to the look-at point
    metric: bool  # whether metres are true ones


def draw(
    config: PerturbationConfig, seed: int, episode: int, variant: int, frames: int, attempt: int = 0
) -> Float[Tensor, "t n"]:
    """Shares of the range of each amount: one row for all frames, or one for each.

    The variants of an episode (with `per_frame` the frames of one) are points of a scrambled Sobol sequence: the first
    two lie in different halves of every range, the first four in different quarters, and so on, however many follow.
    `attempt` gives other draws where one was rejected. -1..1; for jitter standard deviations.
    """
    uniform = _points([seed, episode, attempt], variant, 1)
    if config.per_frame:
        uniform = _points([seed, episode, attempt, variant], 0, frames)
    unit = 2 * uniform[:, : len(AMOUNTS)] - 1
    if isinstance(config, JitterConfig):
        return torch.special.ndtri(uniform[:, : len(AMOUNTS)].double()).float().clamp(-LARGEST_NORMAL, LARGEST_NORMAL)
    if isinstance(config, DriftConfig):
        time = torch.linspace(0, config.cycles, frames)[:, None]
        return unit * torch.sin(2 * math.pi * (time + uniform[:, len(AMOUNTS) :]))
    return unit


def _points(key: list[int], first: int, count: int) -> Float[Tensor, "count n"]:
    """Points of the unit cube, two coordinates per amount."""
    seed = int(np.random.SeedSequence(key).generate_state(1)[0])
    engine = SobolEngine(2 * len(AMOUNTS), scramble=True, seed=seed)
    return engine.fast_forward(first).draw(count)


def amounts_of(
    config: PerturbationConfig,
    share: Float[Tensor, "t n"],
    view: Viewpoint,
    variant: int,
    other: Float[Tensor, "4 4"] | None = None,
) -> Float[Tensor, "t n"]:
    """The amounts that were drawn: degrees, metres, and the logarithm of a factor of the focal length.

    Args:
        config: the kind of change and its range.
        share: from `draw`.
        view: the recorded camera.
        variant: which of a list of poses is meant.
        other: for `other_camera`: world from that camera.

    Raises:
        ConfigError: there is no such kind of change.
    """
    if isinstance(config, PosesConfig):
        row = config.poses[variant % len(config.poses)]
        return _amounts_of_pose(invert_se3(torch.tensor([*row, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)))[None]
    if isinstance(config, OtherCameraConfig):
        assert other is not None
        return _amounts_of_pose(invert_se3(view.camera.world_from_camera[0]) @ other)[None]
    return share * torch.tensor(_bounds(config, view))


def _bounds(config: PerturbationConfig, view: Viewpoint) -> list[float]:
    """The largest value (for jitter: the standard deviation) of each amount."""
    bound = dict.fromkeys(AMOUNTS, 0.0)
    if isinstance(config, OrbitConfig | DriftConfig):
        bound |= {"azimuth_deg": config.azimuth_deg, "elevation_deg": config.elevation_deg}
    if isinstance(config, OrbitConfig | DriftConfig | TranslationConfig | JitterConfig | DollyConfig):
        reach = config.translation_m if view.metric else config.translation_rel * view.distance
        axes = "z" if isinstance(config, DollyConfig) else "xyz"
        bound |= {f"shift_{axis}": reach for axis in axes}
    elif isinstance(config, RotationConfig):
        bound |= {"turn_x_deg": config.tilt_deg, "turn_y_deg": config.pan_deg, "turn_z_deg": config.roll_deg}
    elif isinstance(config, FocalConfig):
        bound["log_zoom"] = math.log1p(config.zoom)
    else:
        raise ConfigError(f"no such perturbation: {type(config).__name__}")
    if isinstance(config, JitterConfig):
        bound |= {f"turn_{axis}_deg": config.rotation_deg for axis in "xyz"}
    return list(bound.values())


def _amounts_of_pose(offset: Float[Tensor, "4 4"]) -> Float[Tensor, " n"]:
    """The amounts of a change given as (recorded camera from new camera): a shift and a turn about one axis."""
    found = torch.zeros(len(AMOUNTS))
    found[SHIFT] = offset[:3, 3]
    found[TURN] = torch.rad2deg(matrix_to_axis_angle(offset[:3, :3]))
    return found


def offsets(amounts: Float[Tensor, "t n"], distance: float) -> Float[Tensor, "t 4 4"]:
    """(Recorded camera from new camera): an orbit about the point at `distance` (m), then a shift, then a turn."""
    orbit = torch.stack([orbit_offset(float(row[0]), float(row[1]), distance) for row in amounts])
    orbit[:, :3, 3] += amounts[:, SHIFT]
    if not bool(amounts[:, TURN].any()):
        return orbit
    return orbit @ se3(axis_angle_to_matrix(torch.deg2rad(amounts[:, TURN])), torch.zeros(len(amounts), 3))


def orbit_offset(azimuth_deg: float, elevation_deg: float, distance: float) -> Float[Tensor, "4 4"]:
    """A camera moved on a sphere about the point at `distance` on its optical axis, still looking at it.

    Positive azimuth moves the camera to its right, positive elevation up; the result maps the new camera's
    coordinates to the recorded camera's.
    """
    # The camera's y axis points down: turning the camera to its right about the point is a negative turn about it.
    a, e = -math.radians(azimuth_deg), -math.radians(elevation_deg)
    sin_a, cos_a, sin_e, cos_e = math.sin(a), math.cos(a), math.sin(e), math.cos(e)
    ahead = (sin_a * cos_e, -sin_e, cos_a * cos_e)  # the new optical axis
    return torch.tensor(
        [
            [cos_a, sin_a * sin_e, ahead[0], -distance * ahead[0]],
            [0.0, cos_e, ahead[1], -distance * ahead[1]],
            [-sin_a, cos_a * sin_e, ahead[2], distance - distance * ahead[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def share_a_world(views: Mapping[str, Viewpoint]) -> bool:
    """Whether the cameras' poses are known in one frame: all calibrated, at different places."""
    cameras = [view.camera for view in views.values()]
    places = {tuple(camera.world_from_camera[0].flatten().tolist()) for camera in cameras}
    return all(camera.origin == "calibration" for camera in cameras) and len(places) == len(cameras) > 1


def moved(
    config: PerturbationConfig, views: Mapping[str, Viewpoint], amounts: Mapping[str, Float[Tensor, "t n"]]
) -> dict[str, CameraTrack]:
    """The new cameras of one episode.

    Cameras that share a world move as one body with the first of them where the change is about what they look at
    (orbit, translation, drift); elsewhere each is changed by the same amounts in its own axes.
    """
    first = next(iter(views))
    if len(views) == 1 or not isinstance(config, OF_THE_RIG) or not share_a_world(views):
        return {key: _changed(view.camera, amounts[key], view.distance) for key, view in views.items()}
    reference = views[first].camera.world_from_camera
    body = reference @ offsets(amounts[first], views[first].distance) @ invert_se3(reference)
    return {
        key: replace(view.camera, world_from_camera=body @ view.camera.world_from_camera) for key, view in views.items()
    }


def _changed(camera: CameraTrack, amounts: Float[Tensor, "t n"], distance: float) -> CameraTrack:
    """The camera changed in its own axes, and its focal length by a factor."""
    intrinsics = camera.intrinsics.clone()
    zoom = amounts[:, -1].exp()[:, None, None]
    intrinsics[:, :2, :2] = camera.intrinsics[:, :2, :2] * zoom
    world_from_camera = camera.world_from_camera @ offsets(amounts, distance)
    return replace(camera, intrinsics=intrinsics, world_from_camera=world_from_camera)


def described(amounts: Float[Tensor, "t n"], view: Viewpoint) -> dict[str, float]:
    """What was drawn, by name: metres where they are true ones, else shares of the look-at distance.

    Of changes that differ from frame to frame, the largest.
    """
    largest = amounts.gather(0, amounts.abs().argmax(0, keepdim=True))[0]
    found = {}
    for name, value in zip(AMOUNTS, largest.tolist(), strict=True):
        if value == 0:
            continue
        if name.startswith("shift"):
            name, value = (f"{name}_m", value) if view.metric else (f"{name}_rel", value / view.distance)
        found[name] = value
    return found


def units_of_shifts(drawn: Sequence[Mapping[str, Mapping[str, float]]]) -> str:
    """A line that says in which unit cameras were shifted; empty if none was. `drawn`: per episode and camera."""
    cameras: dict[str, set[str]] = {"_m": set(), "_rel": set()}
    for episode in drawn:
        for camera, amounts in episode.items():
            for ending, found in cameras.items():
                if any(name.startswith("shift_") and name.endswith(ending) for name in amounts):
                    found.add(camera)
    names = {ending: ", ".join(sorted(found)) for ending, found in cameras.items()}
    said = [
        f"{text} ({names[ending]})"
        for ending, text in (("_m", "metres"), ("_rel", "shares of the look-at distance, as depth has no true scale"))
        if names[ending]
    ]
    return f"shifts are {' and '.join(said)}\n" if said else ""
