"""The camera of a robot's video: searched, refined, checked on frames that were not used, and doubted."""

import logging
import math
import time
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from lerobot_msdyn.robots.calibration.contours import Posed, signed_distance
from lerobot_msdyn.robots.calibration.frames import spread_frames, surface
from lerobot_msdyn.robots.calibration.mounts import mounted_cameras
from lerobot_msdyn.robots.calibration.refine import Problem, Solution, Spread, hits, refined
from lerobot_msdyn.robots.calibration.search import Candidate, Pose, angle_between, search
from lerobot_msdyn.robots.description import Robot

logger = logging.getLogger(__name__)

FEW = 28  # frames in which the camera is looked for by masks
SHORT_FRAMES, SHORT_ROUNDS, SHORT_PX = 14, 8, (8.0, 3.0)  # of each candidate; loss in px of 320
CANDIDATES = 3
MASK_ROUNDS, MASK_PX = 6, (4.0, 1.5)
EDGE_ROUNDS, EDGE_PX = 10, (2.0, 0.7)
LAST_ROUNDS = 4  # with all frames
GROWN = 4  # px of 320 by which the robot is taken larger where the empty scene is looked for
GOOD_HITS = 0.75  # below this, larger errors of the joints are looked for
WIDE, WIDER_PX = Spread(offset_deg=4.0, scale=0.06, noise_deg=1.0), 2.0
LEAST_GAIN = 0.015  # of the share of hits, by which corrected joints must fit better
LEAST_HITS = 0.6  # share of the outlines that lie on edges
LEAST_MARGIN = 0.04  # by which another camera must fit worse
MOST_FOCAL_SD, MOST_TURN_SD_DEG = 0.05, 0.7
OTHER_DEG, OTHER_SHARE = 12.0, 0.3  # what another camera is


@runtime_checkable
class Pictures(Protocol):
    """What pictures show of a robot."""

    def moving(self, frames: Int64[ndarray, " k"]) -> Bool[ndarray, "k h w"]:
        """What moves, the robot and other things."""

    def masks(
        self, robot: Bool[ndarray, "k h w"], frames: Int64[ndarray, " k"]
    ) -> tuple[Bool[ndarray, "k h w"], Bool[ndarray, "h w"]]:
        """What is the robot, and where that can be told; `robot` is slightly too large."""

    def difference(self, robot: Bool[ndarray, "t h w"]) -> tuple[Float32[ndarray, "t h w"], Bool[ndarray, "h w"]]:
        """Distance of colours to those of the empty scene (CIE Lab units), and where it is known."""


@dataclass(frozen=True)
class Verdict:
    """A camera, and how far it can be relied on."""

    solution: Solution
    hits: float  # share of the links' outlines, in frames that were not used, that lie on an edge of what moves
    margin: float  # by which the next best camera has fewer hits
    doubt: str  # why it is not to be used; empty if it is
    seconds: float

    @property
    def confident(self) -> bool:
        """Whether it is to be used."""
        return not self.doubt


def solve(robot: Robot, values: Float64[ndarray, "t j"], rate: Float64[ndarray, "t j"], pictures: Pictures) -> Verdict:
    """The camera that sees the robot where things move.

    Every fourth frame is held out from the refinement and tells how far the camera is right.

    Args:
        robot: its description.
        values: of its movable joints in some frames that differ, of all episodes (rad, m).
        rate: their change per second.
        pictures: what the frames show.
    """
    start = time.perf_counter()
    points = surface(robot, values)
    used, held = _split(points)
    few = used[:FEW]
    masks = pictures.moving(few)
    coarse = Problem(robot, values[few], rate[few], signed_distance(masks), Spread())
    solution, margin = _chosen(coarse, search(masks, points[few], mounted_cameras(robot, values)))
    verdict = _verdict(_slid(coarse, solution, values, rate, pictures, few, used, Spread(), False), held)
    if verdict[1] < GOOD_HITS:
        other = _verdict(_slid(coarse, solution, values, rate, pictures, few, used, WIDE, True), held)
        verdict = max(verdict, other, key=lambda each: each[1])
    solution, share = verdict
    return Verdict(solution, share, margin, _doubt(solution, share, margin), time.perf_counter() - start)


def with_joints(
    verdict: Verdict,
    other: Solution,
    robot: Robot,
    values: Float64[ndarray, "t j"],
    rate: Float64[ndarray, "t j"],
    pictures: Pictures,
) -> Verdict:
    """A camera again, with the joints as another camera of the same robot corrected them: both then share one world.

    Args:
        verdict: the camera that was found by itself.
        other: the other one.
        robot: as for `solve`, and all that follows.
        values: of its joints in the frames of this camera.
        rate: their change per second.
        pictures: what these frames show.
    """
    start = time.perf_counter()
    used, held = _split(surface(robot, values))
    few = used[:FEW]
    first = replace(other, pose=verdict.solution.pose, grown_px=0.0)
    coarse = Problem(robot, values[few], rate[few], signed_distance(pictures.moving(few)), Spread())
    tried: list[tuple[Solution, float]] = []
    for spread in (Spread(), WIDE):
        problem, solution, _ = _slid(coarse, first, values, rate, pictures, few, used, spread, False)
        tried.append((solution, hits(problem, solution, held)))
        if tried[-1][1] >= GOOD_HITS:
            break
    solution, share = max(tried, key=lambda each: each[1])
    seconds = verdict.seconds + time.perf_counter() - start
    return Verdict(solution, share, verdict.margin, _doubt(solution, share, verdict.margin), seconds)


def _split(points: Float32[ndarray, "t n 3"]) -> tuple[Int64[ndarray, " u"], Int64[ndarray, " k"]]:
    """Frames by how differently the robot stands in them: those that are used, and every fourth, which is held out."""
    order = spread_frames(points, len(points))
    return np.delete(order, np.s_[3::4]), order[3::4]


def _chosen(coarse: Problem, found: list[Candidate]) -> tuple[Solution, float]:
    """The candidate that fits best after some rounds, and by how much the next other one fits worse."""
    count = len(coarse.robot.movable)
    kept: list[Candidate] = []
    for candidate in found:
        if len(kept) < CANDIDATES and all(_is_other(candidate.pose, each.pose) for each in kept):
            kept.append(candidate)
    frames = np.arange(min(SHORT_FRAMES, len(coarse.values)))
    starts = [Solution(each.pose, np.zeros(count), np.ones(count)) for each in kept]
    px = _px(SHORT_PX, coarse)
    tried = [refined(coarse, each, frames, SHORT_ROUNDS, px, joints=False) for each in starts]
    shares = [hits(coarse, each, frames) for each in tried]
    best = int(np.argmax(shares))
    others = [share for each, share in zip(tried, shares, strict=True) if _is_other(each.pose, tried[best].pose)]
    text = ", ".join(f"{each.score:.2f} and {share:.2f}" for each, share in zip(kept, shares, strict=True))
    logger.info("cameras by agreement and hits: %s", text)
    return tried[best], shares[best] - max(others, default=0.0)


def _slid(
    coarse: Problem,
    solution: Solution,
    values: Float64[ndarray, "t j"],
    rate: Float64[ndarray, "t j"],
    pictures: Pictures,
    few: Int64[ndarray, " k"],
    used: Int64[ndarray, " u"],
    spread: Spread,
    joints: bool,
) -> tuple[Problem, Solution, Solution]:
    """Onto masks of what moves, then onto those of the robot, then onto edges; without and with corrected joints."""
    wider = WIDER_PX if spread is WIDE else 1.0
    every, px = np.arange(len(few)), _px(MASK_PX, coarse, wider)
    problem = Problem(coarse.robot, coarse.values, coarse.rate, coarse.distance, spread)
    solution = refined(problem, solution, every, MASK_ROUNDS, px, joints)
    problem = problem.with_masks(*pictures.masks(_about(problem, solution), few))
    solution = refined(problem, solution, every, MASK_ROUNDS, px, joints)
    none = np.zeros((len(values), *coarse.distance.shape[1:]), np.float32)
    problem = Problem(coarse.robot, values, rate, none, spread)
    problem = problem.with_difference(*pictures.difference(_about(problem, solution)))
    px = _px(EDGE_PX, coarse, wider)
    solution = refined(problem, solution, used[: len(few)], EDGE_ROUNDS, px, joints)
    solution = refined(problem, solution, used, LAST_ROUNDS, (px[1], px[1]), joints)
    corrected = refined(problem, solution, used, LAST_ROUNDS, (px[1], px[1]), joints=True)
    return problem, solution, corrected


def _verdict(slid: tuple[Problem, Solution, Solution], held: Int64[ndarray, " k"]) -> tuple[Solution, float]:
    """The solution to take, and the share of its hits."""
    problem, solution, corrected = slid
    plain, better = hits(problem, solution, held), hits(problem, corrected, held)
    logger.info("hits of held-out frames: %.3f; with corrected joints %.3f", plain, better)
    return (corrected, better) if better > plain + LEAST_GAIN else (solution, plain)


def _about(problem: Problem, solution: Solution) -> Bool[ndarray, "t h w"]:
    """Where the robot is, slightly larger."""
    posed = Posed(problem.robot, solution.values(problem.values, problem.rate))
    kernel = np.ones((3, 3), np.uint8)
    links = [posed.drawn(frame, solution.pose, *problem.size)[1] for frame in range(len(posed))]
    grown = max(1, round(GROWN * problem.size[0] / 320))
    return np.stack([cv2.dilate((link >= 0).astype(np.uint8), kernel, iterations=grown) for link in links]) > 0


def _px(scale: tuple[float, float], problem: Problem, times: float = 1.0) -> tuple[float, float]:
    """Pixels of the pictures, of those of pictures 320 wide."""
    factor = times * problem.size[0] / 320
    return scale[0] * factor, scale[1] * factor


def _is_other(one: Pose, best: Pose) -> bool:
    """Whether two cameras differ by more than what a refinement mends."""
    apart = float(np.linalg.norm(one.centre - best.centre)) / best.distance
    return angle_between(one.rotation, best.rotation) > math.radians(OTHER_DEG) or apart > OTHER_SHARE


def _doubt(solution: Solution, share: float, margin: float) -> str:
    if share < LEAST_HITS:
        return f"only {share:.0%} of the links' outlines lie where something moves (at least {LEAST_HITS:.0%})"
    if margin < LEAST_MARGIN:
        return "another camera fits as well"
    if solution.covariance is None:
        return "nothing tells how uncertain the camera is"
    focal = float(np.sqrt(solution.covariance[6, 6]))
    if focal > MOST_FOCAL_SD:
        return f"the focal length is uncertain by {focal:.0%}"
    turn_deg = math.degrees(math.sqrt(np.trace(solution.covariance[:3, :3])))
    if turn_deg > MOST_TURN_SD_DEG:
        return f"its direction is uncertain by {turn_deg:.1f} degrees"
    return ""
