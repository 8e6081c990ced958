"""The camera of arms that no one has built, from masks of what moves and their joints."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import torch
from filmed_arm import HEIGHT, NAMES, WIDTH, camera
from made_up_arms import swing, write_arm

from lerobot_msdyn.robots import Robot, load_robot, map_joints
from lerobot_msdyn.robots.calibration.contours import Posed, jacobian, sampled, signed_distance
from lerobot_msdyn.robots.calibration.frames import spread_frames, surface
from lerobot_msdyn.robots.calibration.refine import Problem, Solution, Spread, hits, refined
from lerobot_msdyn.robots.calibration.search import Pose, angle_between
from lerobot_msdyn.robots.calibration.solve import Verdict, solve, with_joints
from lerobot_msdyn.robots.calibration.units import fit, is_settled
from lerobot_msdyn.robots.mapping import in_units

FRAMES = 40


@dataclass
class Filmed:
    """An arm as a camera sees it."""

    robot: Robot
    pose: Pose
    values: np.ndarray
    masks: np.ndarray

    def solution(self, pose: Pose) -> Solution:
        count = len(self.robot.movable)
        return Solution(pose, np.zeros(count), np.ones(count))

    def off(self, pose: Pose) -> tuple[float, float, float]:
        """Rotation in degrees, position and focal length in percent."""
        apart = float(np.linalg.norm(pose.centre - self.pose.centre)) / self.pose.distance
        turned = np.degrees(angle_between(pose.rotation, self.pose.rotation))
        return float(turned), 100 * apart, 100 * abs(pose.focal / self.pose.focal - 1)


def filmed(robot: Robot, pose: Pose, state: np.ndarray) -> Filmed:
    values = map_joints(robot, NAMES, state).values(state)
    posed = Posed(robot, values)
    links = np.stack([posed.drawn(frame, pose, WIDTH, HEIGHT)[1] for frame in range(len(values))])
    moving = (robot.moved_by & (np.ptp(values, axis=0) > 0.03)).any(1)
    return Filmed(robot, pose, values, (links >= 0) & moving[links])


@pytest.fixture(scope="module")
def front(arm: Robot) -> Filmed:
    return filmed(arm, camera(-50, 25, 0.9, 50), swing(FRAMES))


def nearby(pose: Pose, turn: float = 0.06) -> Pose:
    return pose.moved(np.array([turn, -turn, turn, 0.03, -0.02, 0.05, 0.08]))


def test_outlines_move_as_their_derivatives_say(front: Filmed) -> None:
    posed = Posed(front.robot, front.values[:2])
    points = posed.outline(front.pose, (WIDTH, HEIGHT), np.asarray(front.robot.moved_by.any(1)))
    by_pose, by_joints = jacobian(posed, front.pose, points, WIDTH)

    def projected(pose: Pose, point: np.ndarray) -> np.ndarray:
        camera = point @ pose.rotation.T + pose.translation
        return pose.focal * WIDTH * camera[:, :2] / camera[:, 2:] + np.array([WIDTH, HEIGHT]) / 2

    assert projected(front.pose, points.point) == pytest.approx(points.xy, abs=1e-4)
    for k in range(7):
        step = np.zeros(7)
        step[k] = 1e-6
        slope = (projected(front.pose.moved(step), points.point) - points.xy) / 1e-6
        assert by_pose[:, :, k] == pytest.approx(slope, rel=1e-3, abs=1e-2 * np.abs(slope).max())
    for k in range(len(front.robot.movable)):
        values = front.values[:2].copy()
        values[:, k] += 1e-6
        change = Posed(front.robot, values).links @ np.linalg.inv(posed.links)
        moved = change[points.frame, points.link]
        point = np.einsum("nij,nj->ni", moved[:, :3, :3], points.point) + moved[:, :3, 3]
        slope = (projected(front.pose, point) - projected(front.pose, points.point)) / 1e-6
        assert by_joints[:, :, k] == pytest.approx(slope, rel=1e-2, abs=1e-2 * np.abs(by_joints).max())


def test_distances_are_those_to_the_edge_between_pixels() -> None:
    mask = np.zeros((1, 9, 9), bool)
    mask[0, 3:6, 3:6] = True
    value, slope = sampled(signed_distance(mask), np.array([0, 0]), np.array([[6.0, 4.5], [3.0, 4.5]]))
    assert value == pytest.approx([0, 0], abs=1e-6)
    assert slope == pytest.approx(np.array([[1, 0], [-1, 0]]), abs=1e-6)


def test_points_of_an_outline_follow_links_and_camera(front: Filmed) -> None:
    still, size = Posed(front.robot, front.values[:2]), (WIDTH, HEIGHT)
    drawn = still.outline(front.pose, size, np.asarray(front.robot.moved_by.any(1)))
    assert still.moved(drawn, front.pose, size).xy == pytest.approx(drawn.xy, abs=1e-3)
    later, pose = Posed(front.robot, front.values[:2] + 0.02), nearby(front.pose, 0.02)
    moved = later.moved(drawn, pose, size)
    by_hand = later.links @ np.linalg.inv(still.links)
    ahead = by_hand[drawn.frame, drawn.link]
    point = np.einsum("nij,nj->ni", ahead[:, :3, :3], drawn.point) + ahead[:, :3, 3]
    assert moved.point == pytest.approx(point, abs=1e-9)
    seen = point @ pose.rotation.T + pose.translation
    column = pose.focal * WIDTH * seen[:, 0] / seen[:, 2] + WIDTH / 2
    assert moved.xy[:, 0] == pytest.approx(column, abs=1e-6)


def test_outlines_slide_onto_the_masks(front: Filmed) -> None:
    problem = Problem(front.robot, front.values, 0 * front.values, signed_distance(front.masks), Spread())
    start = front.solution(nearby(front.pose))
    frames = spread_frames(surface(front.robot, front.values), 16)
    solution = refined(problem, start, frames, 20, (4.0, 1.0), joints=False)
    turned, apart, focal = front.off(solution.pose)
    assert hits(problem, start, frames) < 0.5 < 0.95 < hits(problem, solution, frames)
    assert turned < 0.3
    assert apart < 1
    assert focal < 1


def test_zeros_of_joints_are_found_with_the_camera(front: Filmed) -> None:
    wrong = front.values - np.radians([0, 3, -3, 3, 0, 0])
    problem = Problem(front.robot, wrong, 0 * wrong, signed_distance(front.masks), Spread(offset_deg=5.0))
    frames = np.arange(0, FRAMES, 2)
    solution = refined(problem, front.solution(nearby(front.pose, 0.02)), frames, 25, (4.0, 1.0))
    assert np.degrees(solution.values(wrong, 0 * wrong)[:, 1:4] - front.values[:, 1:4]) == pytest.approx(0, abs=1.2)


def test_a_late_video_is_told(front: Filmed) -> None:
    rate = np.gradient(front.values, 1 / 30, axis=0)
    late = front.values + rate / 30
    problem = Problem(front.robot, late, rate, signed_distance(front.masks), Spread())
    solution = refined(problem, front.solution(nearby(front.pose, 0.02)), np.arange(0, FRAMES, 2), 20, (4.0, 1.0))
    assert solution.lag_s == pytest.approx(-1 / 30, abs=0.01)


def test_joints_that_are_noisy_do_not_bend_the_camera(front: Filmed) -> None:
    rng = np.random.default_rng(1)
    noisy = front.values + np.radians(rng.normal(0, 1, front.values.shape)) * (np.arange(6) < 5)
    off = {}
    for noise_deg in (0.01, 1.0):
        spread = Spread(noise_deg=noise_deg)
        problem = Problem(front.robot, noisy, 0 * noisy, signed_distance(front.masks), spread)
        frames = np.arange(FRAMES)
        solution = refined(problem, front.solution(nearby(front.pose, 0.02)), frames, 16, (3.0, 0.7), joints=False)
        off[noise_deg] = front.off(solution.pose), hits(problem, solution, frames)
    (turned, apart, focal), share = off[1.0]
    assert share > 0.95 > 0.85 > off[0.01][1]
    assert turned < 0.75 * off[0.01][0][0]
    assert apart < 1
    assert focal < 1


def test_the_unit_of_the_first_joint_is_found_and_its_zero_is_kept(front: Filmed) -> None:
    wrong = front.values.copy()
    wrong[:, 0] = 1.05 * wrong[:, 0]
    problem = Problem(front.robot, wrong, 0 * wrong, signed_distance(front.masks), Spread(scale=0.06))
    assert problem.zero_is_free.tolist() == [False, True, True, True, True, True]
    solution = refined(problem, front.solution(nearby(front.pose, 0.02)), np.arange(0, FRAMES, 2), 16, (4.0, 1.0))
    assert solution.scale[0] == pytest.approx(1 / 1.05, abs=0.015)


@pytest.mark.parametrize(("scale", "hit", "settled"), [(1.0, 0.9, True), (1.0, 0.7, False), (1.08, 0.9, False)])
def test_units_are_settled_where_hardly_anything_was_corrected(
    front: Filmed, scale: float, hit: float, settled: bool
) -> None:
    degrees = map_joints(front.robot, NAMES, swing(FRAMES))
    shares = in_units(front.robot, degrees, "normalised")  # 9 % larger
    solution = replace(front.solution(front.pose), scale=np.full(6, scale))
    verdict = Verdict(solution, hit, 0.3, "", 0.0)
    assert is_settled(degrees, verdict, [degrees, shares]) is settled
    assert fit(verdict) == pytest.approx(hit - 0.5 * (scale - 1))


class OnlyMasks:
    """Pictures of which nothing but masks is known."""

    def __init__(self, masks: np.ndarray) -> None:
        self._masks = masks

    def moving(self, frames: np.ndarray) -> np.ndarray:
        return self._masks[frames]

    def masks(self, robot: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._masks[frames] & robot, np.ones(robot.shape[1:], bool)

    def difference(self, robot: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return 50 * self._masks.astype(np.float32), np.ones(robot.shape[1:], bool)


def test_another_camera_takes_the_joints_of_the_first(front: Filmed) -> None:
    side = filmed(front.robot, camera(20, 40, 0.8, 55), swing(FRAMES))
    wrong = front.values - np.radians([0, 4, -4, 4, 0, 0])
    first = Solution(front.pose, np.radians([0, 4, -4, 4, 0, 0.0]), np.ones(6))
    second = replace(first, pose=nearby(side.pose, 0.02), offset=np.zeros(6))
    verdict = Verdict(second, 0.5, 0.3, "only half", 1.0)
    found = with_joints(verdict, first, front.robot, wrong, 0 * wrong, OnlyMasks(side.masks))
    assert found.solution.offset == pytest.approx(first.offset)
    assert found.confident, found.doubt
    assert found.hits > 0.9
    turned, apart, focal = side.off(found.solution.pose)
    assert turned < 0.3
    assert apart < 1
    assert focal < 1


@pytest.mark.slow
def test_the_camera_is_found_among_other_moving_things(front: Filmed) -> None:
    masks = front.masks.copy()
    for frame in range(FRAMES):
        column = 10 + frame * 2
        masks[frame, 85:110, column : column + 30] = True  # drawn across the picture
        masks[frame, 5:35, 120:155] = True  # turns on its place
    verdict = solve(front.robot, front.values, 0 * front.values, OnlyMasks(masks))
    turned, apart, focal = front.off(verdict.solution.pose)
    assert verdict.confident, verdict.doubt
    assert turned < 1
    assert apart < 3
    assert focal < 3


@pytest.mark.slow
def test_another_robot_is_not_believed(front: Filmed, tmp_path) -> None:
    rng = np.random.default_rng(0)
    other = load_robot(write_arm(tmp_path / "other", seed=7))
    verdict = solve(other, rng.permutation(front.values), 0 * front.values, OnlyMasks(front.masks))
    assert "of the links' outlines" in verdict.doubt


def test_pictures_are_of_the_links(front: Filmed) -> None:
    posed = Posed(front.robot, front.values[:1])
    depth, link = posed.drawn(0, front.pose, WIDTH, HEIGHT)
    assert set(np.unique(link)) <= set(range(-1, len(front.robot.links)))
    rows, columns = np.nonzero(link == front.robot.links.index("lift_link"))
    ray = np.stack(
        [(columns + 0.5 - WIDTH / 2) / front.pose.focal / WIDTH, (rows + 0.5 - HEIGHT / 2) / front.pose.focal / WIDTH]
    )
    camera_points = np.stack([*ray, np.ones(len(rows))], axis=1) * depth[rows, columns][:, None]
    world = (camera_points - front.pose.translation) @ front.pose.rotation
    inside = torch.from_numpy(np.linalg.inv(posed.links[0, front.robot.links.index("lift_link")]))
    local = (inside[:3, :3].numpy() @ world.T).T + inside[:3, 3].numpy()
    shape = front.robot.vertices[
        np.unique(front.robot.faces[front.robot.face_link == front.robot.links.index("lift_link")])
    ]
    assert (local > shape.min(0) - 1e-3).all()
    assert (local < shape.max(0) + 1e-3).all()
    assert cv2.countNonZero((link >= 0).astype(np.uint8)) > 100
