"""Where the camera can be: a search over all views, by how masks and links change together.

Masks hold more than the robot, and links may rest. So each pixel's course over the frames is compared, less its mean:
what does not move with the joints then weighs nothing.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from lerobot_msdyn.render.cpu.threads import in_threads
from lerobot_msdyn.robots.kernels import agreement, cover

AZIMUTHS = 24
ELEVATIONS_DEG = (-5, 10, 25, 40, 57, 75)
FOV_DEG = 56.0  # horizontal; others follow where a camera is improved
SIZES = (0.05, 0.075, 0.11, 0.16, 0.23, 0.33)  # spread of the links' points, in widths of the picture
FRAMES, POINTS, WIDTHS = (14, 20, 28), (300, 500, 900), (40, 56, 80)  # of the three stages
POINTS_PER_CELL = 60  # of a hundredth of the picture; so many cover a cell
TRIES = (36, 12, 6)  # candidates that are improved, one after the other at more length
STEPS, STEP_SIZES = (60, 70, 180), (0.12, 0.06, 0.04)


@dataclass(frozen=True)
class Pose:
    """A camera: pose and focal length."""

    rotation: Float64[ndarray, "3 3"]  # camera from robot
    translation: Float64[ndarray, "3"]  # m
    focal: float  # in widths of the picture

    def moved(self, step: Float64[ndarray, "7"]) -> "Pose":
        """Turned and shifted in its own axes (rad, m) with a focal length by the exponential of the last."""
        turn = _rotation(step[:3])
        return Pose(turn @ self.rotation, turn @ self.translation + step[3:6], self.focal * float(np.exp(step[6])))

    @property
    def distance(self) -> float:
        """From the robot's root, m."""
        return float(np.linalg.norm(self.translation))

    @property
    def centre(self) -> Float64[ndarray, "3"]:
        """Where it stands, in the robot's frame."""
        return -self.rotation.T @ self.translation


@dataclass(frozen=True)
class Candidate:
    """A camera and how well masks and links agree in it: 1 at best."""

    pose: Pose
    score: float


class Agreement:
    """How masks agree with the links as a camera would see them."""

    def __init__(self, masks: Bool[ndarray, "t h w"], points: Float32[ndarray, "t n 3"], width: int) -> None:
        self.height = round(masks.shape[1] * width / masks.shape[2])
        self.width, self.points = width, np.ascontiguousarray(points, np.float32)
        small = shrunk(masks, self.height, width)
        self.centred = np.ascontiguousarray(np.moveaxis(small - small.mean(0), 0, -1))
        self.energy = float((self.centred.astype(np.float64) ** 2).sum())
        self._weight = POINTS_PER_CELL / points.shape[1] * self.height * width / 100

    def coverage(self, pose: Pose) -> Float32[ndarray, "h w t"]:
        """What a camera would see of the links."""
        focal, covered = pose.focal * self.width, np.empty_like(self.centred)
        cover(
            self.points,
            np.ascontiguousarray(pose.rotation),
            pose.translation,
            focal,
            self.width / 2,
            self.height / 2,
            self._weight,
            covered,
        )
        return covered

    def score(self, pose: Pose) -> float:
        """Correlation over time and pixels."""
        product, square = agreement(self.centred, self.coverage(pose))
        return product / max(np.sqrt(square * self.energy), 1e-9)


def search(
    masks: Bool[ndarray, "t h w"], points: Float32[ndarray, "t n 3"], likely: Sequence[Pose] = ()
) -> list[Candidate]:
    """The cameras in which links and masks agree best, the best first.

    Args:
        masks: of what moves, in frames that differ.
        points: of the links' surfaces in the robot's frame, in the same frames (m).
        likely: cameras that are tried in any case.
    """
    order = np.random.default_rng(0).permutation(points.shape[1])

    def stage(index: int) -> Agreement:
        frames = np.linspace(0, len(masks) - 1, min(FRAMES[index], len(masks))).astype(int)
        return Agreement(masks[frames], points[frames][:, order[: POINTS[index]]], WIDTHS[index])

    found = _everywhere(stage(0))
    second, third = stage(1), stage(2)
    for agreement_of, count, steps, size in zip((second, second, third), TRIES, STEPS, STEP_SIZES, strict=True):
        tried = partial(improved, agreement_of, steps=steps, size=size)
        near = likely if agreement_of is third else ()
        found = list(in_threads(tried, [*near, *(each.pose for each in _distinct(found, count))]))
    return _distinct(found, len(found))


def _everywhere(coarse: Agreement) -> list[Candidate]:
    """The best place in the picture for each direction and size, by cross-correlation."""
    height, width = coarse.height, coarse.width
    target = coarse.points.reshape(-1, 3).mean(0).astype(np.float64)
    spread = float(np.sqrt(((coarse.points.reshape(-1, 3) - target) ** 2).sum(1).mean()))
    size = (2 * height, 2 * width)
    masks = np.fft.rfft2(np.moveaxis(coarse.centred, -1, 0), size)
    window = np.fft.rfft2(np.ones((height, width), np.float32), size)
    focal = 0.5 / float(np.tan(np.radians(FOV_DEG) / 2))
    found = []
    for elevation in np.radians(ELEVATIONS_DEG):
        for azimuth in np.arange(AZIMUTHS) * (2 * np.pi / AZIMUTHS):
            rotation = looking_at(azimuth, elevation)
            for share in SIZES:
                distance = spread * focal / share
                if distance < 1.1 * spread:
                    continue
                pose = Pose(rotation, np.array([0, 0, distance]) - rotation @ target, focal)
                covered = np.moveaxis(coarse.coverage(pose), -1, 0)
                product = np.fft.irfft2((masks * np.fft.rfft2(covered, size).conj()).sum(0), size)
                variance = np.fft.rfft2(covered.var(0) * len(covered), size).conj()
                square = np.fft.irfft2(window * variance, size)
                score = product / np.sqrt(np.maximum(square, 1e-3 * square.max() + 1e-9) * coarse.energy)
                best = int(score.argmax())
                row, column = divmod(best, size[1])
                row, column = (row + height) % size[0] - height, (column + width) % size[1] - width
                ray = np.array([column / width / focal, row / width / focal, 1.0])
                found.append(Candidate(_turned(pose, ray), float(score.flat[best])))
    return found


def looking_at(azimuth: float, elevation: float) -> Float64[ndarray, "3 3"]:
    """Camera from robot, for a camera in that direction that looks at the robot without roll (rad)."""
    towards = -np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def _turned(pose: Pose, ray: Float64[ndarray, "3"]) -> Pose:
    """The camera turned so that what was ahead is seen along a ray."""
    axis = np.cross([0.0, 0, 1], ray / np.linalg.norm(ray))
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return pose
    turn = _rotation(axis / sine * np.arctan2(sine, ray[2] / np.linalg.norm(ray)))
    return replace(pose, rotation=turn @ pose.rotation, translation=turn @ pose.translation)


def _rotation(vector: Float64[ndarray, "3"]) -> Float64[ndarray, "3 3"]:
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def angle_between(a: Float64[ndarray, "3 3"], b: Float64[ndarray, "3 3"]) -> float:
    """Of two rotations, rad."""
    return float(np.arccos(np.clip((np.trace(a @ b.T) - 1) / 2, -1, 1)))


def improved(fine: Agreement, pose: Pose, steps: int, size: float) -> Candidate:
    """A camera nearby in which links and masks agree better (Nelder-Mead)."""
    scale = np.array([1, 1, 1, pose.distance, pose.distance, pose.distance, 1.5]) * size

    def cost(step: Float64[ndarray, "7"]) -> float:
        moved = pose.moved(step * scale)
        weak = 0.02 * max(0.0, abs(np.log(moved.focal / 0.9)) - 0.5)
        return weak - fine.score(moved)

    best, value = _simplex(cost, 7, steps)
    return Candidate(pose.moved(best * scale), -value)


def _simplex(cost: Callable[[ndarray], float], size: int, steps: int) -> tuple[Float64[ndarray, " n"], float]:
    """Nelder-Mead from the origin with sides of 1."""
    corners = np.concatenate([np.zeros((1, size)), np.eye(size)])
    values = np.array([cost(corner) for corner in corners])
    taken = len(values)
    while taken < steps:
        order = values.argsort()
        corners, values = corners[order], values[order]
        middle, worst = corners[:-1].mean(0), corners[-1]
        reflected = 2 * middle - worst
        value = cost(reflected)
        taken += 1
        if value < values[0]:
            further = 3 * middle - 2 * worst
            again = cost(further)
            taken += 1
            corners[-1], values[-1] = (further, again) if again < value else (reflected, value)
        elif value < values[-2]:
            corners[-1], values[-1] = reflected, value
        else:
            nearer = middle + 0.5 * ((reflected if value < values[-1] else worst) - middle)
            again = cost(nearer)
            taken += 1
            if again < min(value, values[-1]):
                corners[-1], values[-1] = nearer, again
            else:
                corners[1:] = corners[0] + 0.5 * (corners[1:] - corners[0])
                values[1:] = [cost(corner) for corner in corners[1:]]
                taken += size
    best = int(values.argmin())
    return corners[best], float(values[best])


def _distinct(candidates: list[Candidate], count: int) -> list[Candidate]:
    """The best that differ from each other by more than 8 degrees or 15 % of the distance."""
    kept: list[Candidate] = []
    for candidate in sorted(candidates, key=lambda item: -item.score):
        pose = candidate.pose
        if all(
            angle_between(pose.rotation, other.pose.rotation) > np.radians(8)
            or float(np.linalg.norm(pose.centre - other.pose.centre)) > 0.15 * pose.distance
            for other in kept
        ):
            kept.append(candidate)
        if len(kept) == count:
            break
    return kept


def shrunk(masks: Bool[ndarray, "t H W"], height: int, width: int) -> Float32[ndarray, "t h w"]:
    """Share of each cell that is masked."""
    import cv2

    return np.stack(
        [cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) for mask in masks]
    )
