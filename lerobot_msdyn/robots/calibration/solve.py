"""The camera of a robot's video: searched, refined, checked on frames that were not used, and doubted."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from lerobot_msdyn.robots.calibration.contours import Posed, signed_distance
from lerobot_msdyn.robots.calibration.frames import spread_frames, surface
from lerobot_msdyn.robots.calibration.refine import Problem, Solution, Spread, hits, refined
from lerobot_msdyn.robots.calibration.search import Candidate, angle_between, search
from lerobot_msdyn.robots.description import Robot

logger = logging.getLogger(__name__)

SEARCHED = 28  # frames
SHORT_FRAMES, SHORT_ROUNDS, SHORT_PX = 14, 8, (8.0, 3.0)  # of each of the first candidates; loss in px of 320
LONG_ROUNDS, LONG_PX = 12, (3.0, 1.0)
CANDIDATES = 4
GROWN = 4  # px by which the robot is taken larger where the empty scene is looked for
LEAST_GAIN = 0.015  # of the share of hits, by which corrected joints must fit better
LEAST_HITS = 0.6  # share of the outlines that lie on edges
LEAST_MARGIN = 0.04  # by which another camera must fit worse
MOST_FOCAL_SD = 0.05
OTHER_DEG, OTHER_SHARE = 8.0, 0.2  # what another camera is

# Pixels of the robot [t h w], slightly larger -> what is the robot, and whether that can be told [t h w].
Sharpen = Callable[[Bool[ndarray, "t h w"]], tuple[Bool[ndarray, "t h w"], Bool[ndarray, "t h w"]]]


@dataclass(frozen=True)
class Verdict:
    """A camera, and how far it can be relied on."""

    solution: Solution
    hits: float  # share of the links' outlines, in frames that were not used, that lie on an edge of what moves
    overlap: float  # IoU of the moving links with the masks there
    margin: float  # by which the next best camera has fewer hits
    doubt: str  # why it is not to be used; empty if it is
    seconds: float

    @property
    def confident(self) -> bool:
        """Whether it is to be used."""
        return not self.doubt


def solve(
    robot: Robot,
    values: Float64[ndarray, "t j"],
    rate: Float64[ndarray, "t j"],
    masks: Bool[ndarray, "t h w"],
    sharpen: Sharpen | None = None,
    spread: Spread | None = None,
) -> Verdict:
    """The camera that sees the robot where things move.

    Every fourth frame is held out from the refinement and tells how far the camera is right.

    Args:
        robot: its description.
        values: of its movable joints in some frames that differ, of all episodes (rad, m).
        rate: their change per second.
        masks: of what moves in these frames; more may be in them than the robot.
        sharpen: tells the robot from other things, once it is known where it is.
        spread: what is assumed about the joints.
    """
    start = time.perf_counter()
    points = surface(robot, values)
    order = spread_frames(points, len(points))
    held = order[3::4]
    used = np.array([frame for frame in order if frame not in set(held.tolist())])
    problem = Problem(robot, values, rate, signed_distance(masks), spread or Spread())
    count = len(robot.movable)
    found = search(masks[used[:SEARCHED]], points[used[:SEARCHED]])
    logger.info("search: agreement %s", ", ".join(f"{each.score:.2f}" for each in found[:CANDIDATES]))
    tried = [_short(problem, each, used, count) for each in found[:CANDIDATES]]
    shares = [hits(problem, each, used[:SHORT_FRAMES])[0] for each in tried]
    best = int(np.argmax(shares))
    others = [share for each, share in zip(tried, shares, strict=True) if _is_other(each, tried[best])]
    margin = shares[best] - max(others, default=0.0)
    scale = masks.shape[2] / 320
    solution = refined(problem, tried[best], used, LONG_ROUNDS // 2, _px((3.0, 1.5), scale), joints=False)
    if sharpen is not None:
        problem = replaced(problem, solution, sharpen)
    solution = refined(problem, solution, used, LONG_ROUNDS, _px(LONG_PX, scale), joints=False)
    corrected = refined(problem, solution, used, LONG_ROUNDS, _px(LONG_PX, scale), joints=True)
    plain, overlap = hits(problem, solution, held)
    better, better_overlap = hits(problem, corrected, held)
    logger.info("hits of held-out frames: %.3f; with corrected joints %.3f", plain, better)
    if better > plain + LEAST_GAIN:
        solution, plain, overlap = corrected, better, better_overlap
    doubt = _doubt(solution, plain, margin)
    return Verdict(solution, plain, overlap, margin, doubt, time.perf_counter() - start)


def replaced(problem: Problem, solution: Solution, sharpen: Sharpen) -> Problem:
    """The problem with masks of the robot alone."""
    posed = Posed(problem.robot, solution.values(problem.values, problem.rate))
    kernel = np.ones((3, 3), np.uint8)
    drawn = [
        cv2.dilate(
            (posed.drawn(frame, solution.pose, *problem.size)[1] >= 0).astype(np.uint8), kernel, iterations=GROWN
        )
        for frame in range(len(posed))
    ]
    masks, known = sharpen(np.stack(drawn) > 0)
    return problem.with_masks(masks, known)


def _short(problem: Problem, candidate: Candidate, used: Int64[ndarray, " k"], count: int) -> Solution:
    start = Solution(candidate.pose, np.zeros(count), np.ones(count))
    px = _px(SHORT_PX, problem.size[0] / 320)
    return refined(problem, start, used[:SHORT_FRAMES], SHORT_ROUNDS, px, joints=False)


def _px(scale: tuple[float, float], factor: float) -> tuple[float, float]:
    return scale[0] * factor, scale[1] * factor


def _is_other(one: Solution, best: Solution) -> bool:
    """Whether two cameras differ by more than what a refinement mends."""
    apart = float(np.linalg.norm(one.pose.centre - best.pose.centre)) / best.pose.distance
    return angle_between(one.pose.rotation, best.pose.rotation) > np.radians(OTHER_DEG) or apart > OTHER_SHARE


def _doubt(solution: Solution, share: float, margin: float) -> str:
    if share < LEAST_HITS:
        return f"only {share:.0%} of the links' outlines lie where something moves (at least {LEAST_HITS:.0%})"
    if margin < LEAST_MARGIN:
        return "another camera fits as well"
    deviation = np.inf if solution.covariance is None else float(np.sqrt(solution.covariance[6, 6]))
    if deviation > MOST_FOCAL_SD:
        return f"the focal length is uncertain by {deviation:.0%}"
    return ""
