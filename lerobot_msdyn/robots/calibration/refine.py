"""The camera, refined: outlines of the links slide onto the edges of what moves (Gauss-Newton, Cauchy loss)."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from lerobot_msdyn.robots.calibration.contours import Outline, Posed, edges_across, jacobian, sampled, signed_distance
from lerobot_msdyn.robots.calibration.search import Pose
from lerobot_msdyn.robots.description import Robot

KNOWN = 0.99
LEAST_POINTS, MOST_POINTS = 50, 9000  # of all outlines, in one step
DRAWN = 2  # rounds for which outlines that were drawn serve


@dataclass(frozen=True)
class Spread:
    """Standard deviations of what is assumed before anything is seen."""

    offset_deg: float = 1.5  # of each joint's zero
    scale: float = 0.02  # of each joint's unit, relative
    lag_s: float = 0.03  # of the state behind the video
    noise_deg: float = 0.1  # of each joint in each frame
    grown_px: float = 0.5  # by which masks are larger than what they show
    log_focal: float = 0.4


@dataclass(frozen=True)
class Solution:
    """A camera, and corrections of the joints."""

    pose: Pose
    offset: Float64[ndarray, " j"]  # rad, or m
    scale: Float64[ndarray, " j"]
    lag_s: float = 0.0
    grown_px: float = 0.0
    covariance: Float64[ndarray, "7 7"] | None = None  # of `Pose.moved`

    def values(self, values: Float64[ndarray, "t j"], rate: Float64[ndarray, "t j"]) -> Float64[ndarray, "t j"]:
        """Corrected values of the joints."""
        return (values + self.lag_s * rate) * self.scale + self.offset


class Problem:
    """Frames, the joints in them, and the edges of what moves."""

    def __init__(
        self,
        robot: Robot,
        values: Float64[ndarray, "t j"],
        rate: Float64[ndarray, "t j"],
        distance: Float32[ndarray, "t h w"],
        spread: Spread,
        known: Float32[ndarray, "t h w"] | None = None,
        difference: Float32[ndarray, "t h w"] | None = None,
    ) -> None:
        self.robot, self.values, self.rate, self.distance, self.spread = robot, values, rate, distance, spread
        self.known = known  # 1 where masks and differences can be relied on
        self.difference = difference  # to the empty scene, CIE Lab units
        self.size = (distance.shape[2], distance.shape[1])
        span = np.ptp(values, axis=0)
        active = span > np.radians(1.5)
        self.moving = (robot.moved_by & active).any(1)
        # The zero of what turns everything that moves cannot be told from a turn of the camera.
        self.zero_is_free = ~robot.moved_by[self.moving].all(0)

    def with_masks(self, masks: Bool[ndarray, "t h w"], known: Bool[ndarray, "h w"]) -> "Problem":
        """The same with other masks, which are to be relied on in some pixels alone."""
        distance, where = signed_distance(masks), np.broadcast_to(known, masks.shape).astype(np.float32)
        return Problem(self.robot, self.values, self.rate, distance, self.spread, where)

    def with_difference(self, difference: Float32[ndarray, "t h w"], known: Bool[ndarray, "h w"]) -> "Problem":
        """The same with edges of pictures' differences to the empty scene, instead of masks."""
        where = np.broadcast_to(known, difference.shape).astype(np.float32)
        return Problem(self.robot, self.values, self.rate, self.distance, self.spread, where, difference)

    def observed(
        self, frames: Int64[ndarray, " k"], points: Outline
    ) -> tuple[Float64[ndarray, " n"], Float64[ndarray, "n 2"], Bool[ndarray, " n"]]:
        """Distance of an outline to the masks' edges (px), its slope, and whether it can be relied on."""
        value, slope = sampled(self.distance[frames], points.frame, points.xy)
        if self.known is None:
            return value, slope, np.ones(len(value), bool)
        known, _ = sampled(self.known[frames], points.frame, points.xy)
        if self.difference is None:
            return value, slope, known > KNOWN
        value, usable = edges_across(self.difference[frames], points, self.size[0] / 320)
        return value, points.normal, usable & (known > KNOWN)


def refined(
    problem: Problem,
    start: Solution,
    frames: Int64[ndarray, " k"],
    rounds: int,
    scale_px: tuple[float, float],
    joints: bool = True,
) -> Solution:
    """A solution after some rounds; the outlines are drawn anew in every other.

    What the joints are off by in single frames is solved in each round, and eliminated (Schur complement).
    """
    solution, points = start, None
    noise = np.zeros((len(frames), len(problem.robot.movable)))
    for number in range(rounds):
        width = _narrowed(scale_px, number, rounds)
        posed = Posed(problem.robot, solution.values(problem.values[frames], problem.rate[frames]) + noise)
        if points is None or number % DRAWN == 0:
            points = posed.outline(solution.pose, problem.size, problem.moving).thinned(MOST_POINTS)
        else:
            points = posed.moved(points, solution.pose, problem.size)
        if len(points) < LEAST_POINTS:
            return solution
        seen = _Seen(problem, solution, frames, posed, points, width)
        solution, noise = _step(problem, solution, frames, seen, noise, joints)
    return solution


def _narrowed(scale_px: tuple[float, float], number: int, rounds: int) -> float:
    return scale_px[0] * (scale_px[1] / scale_px[0]) ** (number / max(rounds - 1, 1))


class _Seen:
    """Residuals of an outline, how they change, and what each is worth."""

    def __init__(
        self,
        problem: Problem,
        solution: Solution,
        frames: Int64[ndarray, " k"],
        posed: Posed,
        points: Outline,
        scale_px: float,
    ) -> None:
        value, slope, known = problem.observed(frames, points)
        by_pose, by_joints = jacobian(posed, solution.pose, points, problem.size[0])
        self.frame = points.frame
        self.residual = value + solution.grown_px
        self.by_pose = np.einsum("ni,nij->nj", slope, by_pose)
        self.by_joints = np.einsum("ni,nij->nj", slope, by_joints)
        # Neighbouring points of an outline are wrong together: about ten of them are one measurement, of half a pixel.
        self.weight = known / (1 + (self.residual / scale_px) ** 2) / (10 * 0.5**2)

    def of_noise(
        self, design: Float64[ndarray, "n p"], noise: Float64[ndarray, "k j"], spread: Spread
    ) -> tuple[Float64[ndarray, "k j j"], Float64[ndarray, "k j p"], Float64[ndarray, "k j"]]:
        """Normal equations of each frame's joints: their own part, the part shared with `design`, and the gradient."""
        strength = 1 / np.radians(spread.noise_deg) ** 2
        count, width = noise.shape[1], design.shape[1]
        own = np.repeat(strength * np.eye(count)[None], len(noise), axis=0)
        shared, slope = np.zeros((len(noise), count, width)), strength * noise
        present, starts = np.unique(self.frame, return_index=True)
        for frame, points in zip(present, np.split(np.arange(len(self.frame)), starts[1:]), strict=True):
            weighted = (self.by_joints[points] * self.weight[points, None]).T
            own[frame] += weighted @ self.by_joints[points]
            shared[frame] = weighted @ design[points]
            slope[frame] += weighted @ self.residual[points]
        return own, shared, slope


def _step(
    problem: Problem,
    solution: Solution,
    frames: Int64[ndarray, " k"],
    seen: _Seen,
    noise: Float64[ndarray, "k j"],
    joints: bool,
) -> tuple[Solution, Float64[ndarray, "k j"]]:
    columns = [seen.by_pose, np.ones((len(seen.residual), 1))]
    spread, count = problem.spread, noise.shape[1]
    prior = [0.0] * 6 + [1 / spread.log_focal, 1 / spread.grown_px]
    at = [0.0] * 6 + [float(np.log(solution.pose.focal / 0.9)), solution.grown_px]
    if joints:
        values, rate = problem.values[frames], problem.rate[frames][seen.frame]
        mean = values.mean(0)
        columns += [seen.by_joints * problem.zero_is_free, seen.by_joints * (values[seen.frame] - mean)]
        columns += [(seen.by_joints * rate).sum(1, keepdims=True)]
        prior += [1 / np.radians(spread.offset_deg)] * count + [1 / spread.scale] * count + [1 / spread.lag_s]
        at += [*(solution.offset + (solution.scale - 1) * mean), *(solution.scale - 1), solution.lag_s]
    design, strength = np.concatenate(columns, 1), np.array(prior)
    own, shared, slope = seen.of_noise(design, noise, spread)
    eliminated = np.linalg.solve(own, np.concatenate([shared, slope[..., None]], axis=2))
    weighted = (design * seen.weight[:, None]).T
    normal = weighted @ design - np.einsum("kjp,kjq->pq", shared, eliminated[..., :-1]) + np.diag(strength**2)
    right = (
        -(weighted @ seen.residual) + np.einsum("kjp,kj->p", shared, eliminated[..., -1]) - strength**2 * np.array(at)
    )
    step = np.linalg.solve(normal + np.diag(1e-9 * np.diag(normal) + 1e-12), right)
    covariance = np.linalg.inv(normal + 1e-9 * np.eye(len(normal)) * np.diag(normal).max() * 1e-6)[:7, :7]
    noise = noise - eliminated[..., -1] - eliminated[..., :-1] @ step
    pose, grown = solution.pose.moved(step[:7]), float(solution.grown_px + step[7])
    if not joints:
        return replace(solution, pose=pose, grown_px=grown, covariance=covariance), noise
    d_offset, d_scale, d_lag = step[8 : 8 + count], step[8 + count : 8 + 2 * count], step[-1]
    offset, scale = solution.offset + d_offset - d_scale * mean, solution.scale + d_scale
    return Solution(pose, offset, scale, solution.lag_s + float(d_lag), grown, covariance), noise


def _noise(
    problem: Problem, solution: Solution, frames: Int64[ndarray, " k"], scale_px: tuple[float, float], rounds: int = 3
) -> Float64[ndarray, "k j"]:
    """What the joints are off by in single frames; all else is kept."""
    noise: Float64[ndarray, "k j"] = np.zeros((len(frames), len(problem.robot.movable)))
    values = solution.values(problem.values[frames], problem.rate[frames])
    points = Posed(problem.robot, values).outline(solution.pose, problem.size, problem.moving)
    for number in range(rounds if len(points) else 0):
        posed = Posed(problem.robot, values + noise)
        points = posed.moved(points, solution.pose, problem.size)
        seen = _Seen(problem, solution, frames, posed, points, _narrowed(scale_px, number, rounds))
        own, _, slope = seen.of_noise(np.zeros((len(points), 0)), noise, problem.spread)
        noise = noise - np.linalg.solve(own, slope[..., None])[..., 0]
    return noise


def hits(problem: Problem, solution: Solution, frames: Int64[ndarray, " k"], within_px: float = 1.5) -> float:
    """Share of the outline within some pixels (of a picture 320 wide) of an edge, once single frames' noise of the
    joints is solved.
    """
    scale = problem.size[0] / 320
    noise = _noise(problem, solution, frames, (2 * within_px * scale, within_px * scale))
    posed = Posed(problem.robot, solution.values(problem.values[frames], problem.rate[frames]) + noise)
    points = posed.outline(solution.pose, problem.size, problem.moving)
    if not len(points):
        return 0.0
    value, _, told = problem.observed(frames, points)
    hit = told & (np.abs(value + solution.grown_px) < within_px * scale)
    known = len(points)
    if problem.known is not None:
        known = int((sampled(problem.known[frames], points.frame, points.xy)[0] > KNOWN).sum())
    return float(hit.sum() / max(known, 1))
