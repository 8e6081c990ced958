"""The change of all cameras of an episode: sampled from (seed, episode, variant), and the new cameras that it gives."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from numpy import ndarray
from torch import Tensor
from torch.quasirandom import SobolEngine

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.geometry import invert_se3
from lerobot_msdyn.core.perturbation import AMOUNTS, Perturbation, Viewpoint, check_pose
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.scene.store import SavedScene
from lerobot_msdyn.views.offsets import offsets

DIMENSIONS = 2 * len(AMOUNTS)  # coordinates of a sample


@dataclass(frozen=True)
class CameraChange:
    """What is to be changed of each camera of an episode."""

    views: Mapping[str, Viewpoint]
    amounts: Mapping[str, Float[Tensor, "s n"]]  # per camera its AMOUNTS: one row for all frames, or one for each
    moves_rig: bool  # calibrated cameras as one body

    def at(self, frame: int) -> "CameraChange":
        """The change at one frame, for all frames."""
        rows = {key: rows[frame : frame + 1] if len(rows) > 1 else rows for key, rows in self.amounts.items()}
        return replace(self, amounts=rows)

    def cameras(self, factor: int | float = 1.0) -> dict[str, CameraTrack]:
        """The new cameras, a share of the way to the whole change."""
        amounts = {key: factor * rows for key, rows in self.amounts.items()}
        zoomed = {key: _zoomed(view.camera, amounts[key]) for key, view in self.views.items()}
        if self.moves_rig and share_a_world(self.views):
            first = next(iter(self.views))
            reference = self.views[first].camera.world_from_camera
            body = (
                reference
                @ offsets(amounts[first], self.views[first].distance, self.views[first].up)
                @ invert_se3(reference)
            )
            poses = {key: body @ camera.world_from_camera for key, camera in zoomed.items()}
        else:
            poses = {
                key: camera.world_from_camera @ offsets(amounts[key], self.views[key].distance, self.views[key].up)
                for key, camera in zoomed.items()
            }
        return {key: replace(camera, world_from_camera=poses[key]) for key, camera in zoomed.items()}

    def described(self) -> dict[str, dict[str, float]]:
        """Per camera the amounts by name, as they are recorded."""
        return {key: _described(rows, self.views[key]) for key, rows in self.amounts.items()}


def sample_change(
    perturbation: Perturbation,
    scenes: Mapping[str, Reconstruction | SavedScene],
    seed: int,
    episode: int,
    variant: int,
    attempt: int = 0,
    other: Float[Tensor, "4 4"] | None = None,
) -> CameraChange:
    """One change for all cameras of an episode; a function of the seed and the numbers.

    The first variants of all episodes are points of one scrambled Sobol sequence, so that few episodes fill the ranges
    evenly. The binary digits of another such sequence change those of further variants: the first two of an episode lie
    in different halves of every range, the first four in different quarters, and so on, however many follow. With
    `per_frame` the frames of a new episode are points of a sequence of their own.

    Args:
        perturbation: the kind of change and its range.
        scenes: per camera key its scene.
        seed: of all random choices.
        episode: of the source.
        variant: number of the new episode among those of the source episode.
        attempt: gives other samples where one was rejected.
        other: world from the camera that `perturbation.needs_pose_of` names.

    Raises:
        ConfigError: that pose is missing, or a kind of the user's own is not as it must be.
    """
    check_pose(perturbation, other)
    views = {
        key: Viewpoint(scene.camera, scene.distance, scene.metric, scene.up, other) for key, scene in scenes.items()
    }
    frames = min((len(view.camera) for view in views.values()), default=1)
    if perturbation.per_frame:
        points = _points([seed, episode, attempt, variant], frames)
    else:
        points = _point([seed, attempt], episode, variant)
    shares = perturbation.shares(points[:, : len(AMOUNTS)], points[:, len(AMOUNTS) :], frames)
    amounts = {key: perturbation.amounts(shares, view, variant) for key, view in views.items()}
    rows = {key: _checked(perturbation, values, frames) for key, values in amounts.items()}
    return CameraChange(views, rows, perturbation.moves_rig)


def _points(key: Sequence[int], count: int) -> Float32[ndarray, "count m"]:
    """The first points of a scrambled Sobol sequence in the unit cube, two coordinates per amount."""
    points: ndarray = SobolEngine(DIMENSIONS, scramble=True, seed=_seed(key)).draw(count).numpy()
    return points


def _point(key: Sequence[int], episode: int, variant: int) -> Float32[ndarray, "1 m"]:
    """One point of the unit cube: an episode's of a scrambled Sobol sequence, its digits changed by a variant's."""
    digits = sobol_digits(_seed(key), episode) ^ sobol_digits(None, variant)
    return (digits / (1 << SobolEngine.MAXBIT)).astype(np.float32)[None]


def sobol_digits(seed: int | None, index: int) -> Int64[ndarray, " m"]:
    """The binary digits of a Sobol sequence's point (2^30 times the point), of any index at the same cost.

    Args:
        seed: of the scrambling; None: not scrambled.
        index: from 0, of 2^30 points, after which they come again.
    """
    directions, shift = _sobol(seed)
    gray = (index ^ (index >> 1)) % (1 << SobolEngine.MAXBIT)
    chosen = [bit for bit in range(SobolEngine.MAXBIT) if gray >> bit & 1]
    digits: ndarray = np.bitwise_xor.reduce(directions[:, chosen], axis=1) ^ shift
    return digits


@lru_cache(maxsize=16)
def _sobol(seed: int | None) -> tuple[Int64[ndarray, "m bits"], Int64[ndarray, " m"]]:
    """Direction numbers and first point of a Sobol sequence; to make them takes torch some milliseconds."""
    engine = SobolEngine(DIMENSIONS, scramble=seed is not None, seed=seed)
    return engine.sobolstate.numpy(), engine.shift.numpy()


def _seed(key: Sequence[int]) -> int:
    return int(np.random.SeedSequence(key).generate_state(1)[0])


def _checked(perturbation: Perturbation, amounts: ndarray, frames: int) -> Float[Tensor, "s n"]:
    """Amounts of a camera, which may come from a user's own code."""
    values = np.array(amounts, np.float32)
    if values.shape not in ((1, len(AMOUNTS)), (frames, len(AMOUNTS))) or not np.isfinite(values).all():
        raise ConfigError(
            f"perturbation {perturbation.type_name!r} gives amounts of shape {list(values.shape)}; expected finite "
            f"numbers, {len(AMOUNTS)} in each of 1 or {frames} rows"
        )
    return torch.from_numpy(values)


def share_a_world(views: Mapping[str, Viewpoint]) -> bool:
    """Whether the cameras' poses are known in one frame, at different places."""
    cameras = [view.camera for view in views.values()]
    places = {tuple(camera.world_from_camera[0].flatten().tolist()) for camera in cameras}
    worlds = {camera.world for camera in cameras}
    return len(worlds) == 1 and "" not in worlds and len(places) == len(cameras) > 1


def _zoomed(camera: CameraTrack, amounts: Float[Tensor, "s n"]) -> CameraTrack:
    """The camera with its focal length changed; the principal point stays."""
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, :2, :2] *= amounts[:, -1].exp()[:, None, None]
    return replace(camera, intrinsics=intrinsics)


def _described(amounts: Float[Tensor, "s n"], view: Viewpoint) -> dict[str, float]:
    """Amounts by name: metres where they are true ones, else shares of the look-at distance; no zeros.

    Of changes that differ from frame to frame, the largest.
    """
    largest = amounts.gather(0, amounts.abs().argmax(0, keepdim=True))[0]
    by_name = {}
    for name, value in zip(AMOUNTS, largest.tolist(), strict=True):
        if value == 0:
            continue
        if name.startswith("shift"):
            name, value = (f"{name}_m", value) if view.metric else (f"{name}_rel", value / view.distance)
        by_name[name] = value
    return by_name


def units_of_shifts(episodes: Sequence[Mapping[str, Mapping[str, float]]]) -> str:
    """A line that says in which unit cameras were shifted; empty if none was. Per episode and camera its amounts."""
    cameras: dict[str, set[str]] = {"_m": set(), "_rel": set()}
    for episode in episodes:
        for camera, amounts in episode.items():
            for ending, shifted in cameras.items():
                if any(name.startswith("shift_") and name.endswith(ending) for name in amounts):
                    shifted.add(camera)
    units = (("_m", "metres"), ("_rel", "shares of the look-at distance, as depth has no true scale"))
    parts = [f"{unit} ({', '.join(sorted(cameras[ending]))})" for ending, unit in units if cameras[ending]]
    return f"shifts are {' and '.join(parts)}\n" if parts else ""
