"""How often the camera of a made-up arm is found, and how often a wrong one is believed.

python benchmarks/robot_cameras.py --case random --count 100 --results cameras.jsonl

Cases: `random` (any arm, any view, something else turns and moves; the first joint rests in a third of them), `spin`
(two joints rest, and a large disc turns), `disturbed` (the state in -100..100 of ranges that are off by 3 degrees and
3 %, with noise of 1 degree, one frame ahead of the video; masks worse by patches, blobs and holes; a turn about the
first joint's axis, whose zero cannot be told, is no error). A camera is wrong if it is further off than 0.5 degree, or
1.5 % of its distance, and three standard deviations that it states. A results file is gone on with.
"""

import argparse
import json
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "helpers"))

from filmed_arm import HEIGHT, NAMES, WIDTH, camera, pictures
from made_up_arms import swing, write_arm

from lerobot_msdyn.priors.masks.robot import RobotPictures
from lerobot_msdyn.robots import Robot, load_robot, map_joints
from lerobot_msdyn.robots.calibration.contours import Posed
from lerobot_msdyn.robots.calibration.search import Pose, angle_between
from lerobot_msdyn.robots.calibration.solve import Solution, Verdict, solve
from lerobot_msdyn.robots.calibration.units import fit, is_settled
from lerobot_msdyn.robots.mapping import in_units

CASES = ("random", "spin", "disturbed")
FRAMES, FPS = 96, 30  # as many as the product looks at
WRONG_DEG, WRONG_SHARE, WRONG_SD = 0.5, 0.015, 3.0


@dataclass(frozen=True)
class Case:
    """An arm, its camera, and what is recorded."""

    robot: Robot
    pose: Pose
    values: np.ndarray  # of the joints as they are in the pictures (rad)
    state: np.ndarray  # as recorded
    frames: np.ndarray


class WorseMasks(RobotPictures):
    """Masks that are too large or too small in patches, with blobs and holes; the pictures are as they are."""

    def __init__(self, frames: np.ndarray, seed: int) -> None:
        super().__init__(frames)
        self._seed = seed

    def moving(self, frames: np.ndarray) -> np.ndarray:
        """Worse."""
        return self._worse(super().moving(frames))

    def masks(self, robot: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Worse."""
        masks, known = super().masks(robot, frames)
        return self._worse(masks), known

    def _worse(self, masks: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(self._seed)
        kernel = np.ones((3, 3), np.uint8)
        out = []
        for mask in masks.astype(np.uint8):
            patches = cv2.resize(rng.uniform(0, 1, (6, 8)).astype(np.float32), mask.shape[::-1]) > 0.5
            worse = np.where(patches, cv2.dilate(mask, kernel, iterations=2), cv2.erode(mask, kernel, iterations=1))
            for value in (0, 1):
                centre = tuple(int(number) for number in rng.uniform(0, 1, 2) * mask.shape[::-1])
                cv2.circle(worse, centre, int(rng.uniform(6, 12) * WIDTH / 160), value, -1)
            out.append(worse > 0)
        return np.stack(out)


def made(case: str, seed: int, folder: Path) -> Case:
    """One arm before one camera."""
    rng = np.random.default_rng(seed)
    robot = load_robot(write_arm(folder / str(seed), seed))
    fov = rng.uniform(35, 75)
    distance = rng.uniform(0.75, 1.1) * 0.55 / np.tan(np.radians(fov) / 2)
    pose = camera(rng.uniform(0, 360), rng.uniform(5, 75), distance, fov)
    state = swing(FRAMES, seed) + rng.normal(0, 0.2, (FRAMES, 6))
    resting = {"random": [0] if seed % 3 == 0 else [], "spin": [0, 1], "disturbed": []}[case]
    state[:, resting] = state[0, resting]
    frames = pictures(robot, pose, state)
    (_turning_disc if case == "spin" else _moving_box)(frames, rng)
    values = map_joints(robot, NAMES, state).values(state)
    if case == "disturbed":
        state = _recorded_badly(robot, state, rng)
    return Case(robot, pose, values, state, frames)


def _recorded_badly(robot: Robot, state: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """In -100..100 of ranges that are not quite those of the description, noisy, and one frame ahead."""
    middles, spans = np.array(
        [(np.degrees(j.lower + j.upper) / 2, np.degrees(j.upper - j.lower)) for j in _turning(robot)]
    ).T
    middles = middles + 3 * rng.choice([-1, 1], len(middles))
    spans = spans * (1 + 0.03 * rng.choice([-1, 1], len(spans)))
    out = np.concatenate([state[1:], state[-1:]])
    out[:, :5] = (out[:, :5] + rng.normal(0, 1, (len(out), 5)) - middles) / spans * 200
    return out


def _turning(robot: Robot) -> list[Any]:
    return [robot.joint(name) for name in robot.movable[:5]]


def _moving_box(frames: np.ndarray, rng: np.random.Generator) -> None:
    """Something else turns and moves across the picture."""
    x, y = rng.uniform(0.15, 0.85, 2) * (WIDTH, HEIGHT)
    speed = rng.uniform(-1, 1, 2) * (WIDTH, HEIGHT) / len(frames) / 2
    colour = tuple(int(value) for value in rng.integers(0, 255, 3))
    for t, frame in enumerate(frames):
        box = ((float(x + t * speed[0]), float(y + t * speed[1])), (30.0, 14.0), 17.0 * t)
        cv2.fillPoly(frame, [cv2.boxPoints(box).astype(np.int32)], colour)


def _turning_disc(frames: np.ndarray, rng: np.random.Generator) -> None:
    """A large disc of sectors turns at the side of the picture, below the robot where they meet."""
    side, bottom = int(rng.uniform(0.15, 0.85) * WIDTH), int(rng.uniform(0.6, 0.9) * HEIGHT)
    colours = [tuple(int(value) for value in rng.integers(0, 255, 3)) for _ in range(7)]
    for t, frame in enumerate(frames):
        for index, colour in enumerate(colours):
            angle = 11.0 * t + 360 / 7 * index
            cv2.ellipse(frame, (side, bottom), (34, 20), 0, angle, angle + 360 / 7, colour, -1)


def solved(case: Case, worse: bool, seed: int) -> tuple[Verdict, np.ndarray]:
    """What the product makes of it, and the joints that it takes."""
    shown = WorseMasks(case.frames, seed) if worse else RobotPictures(case.frames)
    mapping = map_joints(case.robot, NAMES, case.state)
    tried = []
    mappings = (mapping, in_units(case.robot, mapping, "normalised"))
    for each in mappings:
        values = each.values(case.state)
        rate = np.gradient(values, 1 / FPS, axis=0)
        verdict = solve(case.robot, values, rate, shown)
        tried.append((fit(verdict), verdict, verdict.solution.values(values, rate)))
        if is_settled(each, verdict, mappings):
            break
    _, verdict, joints = max(tried, key=lambda item: item[0])
    return verdict, joints


def one(name: str, seed: int, folder: Path) -> dict[str, Any]:
    """Errors, what is stated of them, and whether the camera is believed."""
    case = made(name, seed, folder)
    start = time.process_time()
    verdict, joints = solved(case, name == "disturbed", seed)
    seconds = time.process_time() - start
    found = verdict.solution.pose
    if name == "disturbed":
        found = _turned_back(found, case.pose)
    turned = float(np.degrees(angle_between(found.rotation, case.pose.rotation)))
    apart = float(np.linalg.norm(found.centre - case.pose.centre)) / case.pose.distance
    sd_turn, sd_apart, sd_focal = _stated(verdict.solution)
    wrong = turned > WRONG_DEG + WRONG_SD * sd_turn or apart > WRONG_SHARE + WRONG_SD * sd_apart
    return {
        "case": name,
        "seed": seed,
        "turned_deg": turned,
        "apart": apart,
        "focal": found.focal / case.pose.focal - 1,
        "depth": _depth_error(case, verdict.solution, joints),
        "sd_turned_deg": sd_turn,
        "sd_apart": sd_apart,
        "sd_focal": sd_focal,
        "hits": verdict.hits,
        "margin": verdict.margin,
        "doubt": verdict.doubt,
        "wrong": bool(wrong),
        "cpu_s": seconds,
    }


def _turned_back(found: Pose, true: Pose) -> Pose:
    """The camera turned about the first joint's axis to where it is most right: this is the zero of that joint."""
    between = found.rotation.T @ true.rotation
    angle = np.arctan2(between[1, 0] - between[0, 1], between[0, 0] + between[1, 1])
    about = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return replace(found, rotation=found.rotation @ about)


def _stated(solution: Solution) -> tuple[float, float, float]:
    """Standard deviations of rotation (degrees), position and focal length (shares)."""
    if solution.covariance is None:
        return 0.0, 0.0, 0.0
    variance = np.diag(solution.covariance)
    turn, shift = np.sqrt(variance[:3].sum()), np.sqrt(variance[3:6].sum())
    return float(np.degrees(turn)), float(shift / solution.pose.distance), float(np.sqrt(variance[6]))


def _depth_error(case: Case, solution: Solution, joints: np.ndarray) -> float:
    """Median over frames of the arm's mean relative error of depth."""
    some = slice(None, None, 8)
    true, found = Posed(case.robot, case.values[some]), Posed(case.robot, joints[some])
    errors = []
    for frame in range(len(true)):
        before, _ = true.drawn(frame, case.pose, WIDTH, HEIGHT)
        after, _ = found.drawn(frame, solution.pose, WIDTH, HEIGHT)
        both = (before > 0) & (after > 0)
        errors.append(float(np.abs(after[both] / before[both] - 1).mean()) if both.any() else 1.0)
    return float(np.median(errors))


def line(row: dict[str, Any]) -> str:
    """One camera in words."""
    return (
        f"{row['seed']}: {row['turned_deg']:.2f} ± {row['sd_turned_deg']:.2f} deg, {row['apart']:.1%} ± "
        f"{row['sd_apart']:.1%}, focal {row['focal']:+.1%} ± {row['sd_focal']:.1%}, depth {row['depth']:.1%}; hits "
        f"{row['hits']:.2f}, margin {row['margin']:.2f}; {row['cpu_s']:.0f} s; {row['doubt'] or 'believed'}"
        + (" WRONG" if row["wrong"] else "")
    )


def summary(rows: list[dict[str, Any]]) -> str:
    """Shares and medians."""
    wrong = [row for row in rows if row["wrong"]]
    believed = [row for row in rows if not row["doubt"]]
    doubted = [row for row in rows if row["doubt"]]
    text = (
        f"{len(rows)} cameras: {len(believed)} believed, of which {sum(row['wrong'] for row in believed)} are wrong; "
        f"{len(doubted)} doubted, of which {sum(not row['wrong'] for row in doubted)} are right; "
        f"{len(wrong)} wrong in all; {np.mean([row['cpu_s'] for row in rows]):.1f} CPU s each"
    )
    if not believed:
        return text
    names = ("turned_deg", "apart", "focal", "depth")
    values = np.array([[abs(row[name]) for name in names] for row in believed])
    for share, turned, apart, focal, depth in zip(
        (50, 90, 99), *np.percentile(values, (50, 90, 99), axis=0).T, strict=True
    ):
        text += f"\nbelieved, {share} %: {turned:.2f} deg, {apart:.2%}, focal {focal:.2%}, arm's depth {depth:.2%}"
    return text


def main() -> None:
    """Print one line per camera, and the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", choices=CASES, default="random")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--results", type=Path, help="lines of JSON, gone on with")
    arguments = parser.parse_args()
    done: dict[int, dict[str, Any]] = {}
    if arguments.results is not None and arguments.results.exists():
        rows = [json.loads(text) for text in arguments.results.read_text().splitlines()]
        done = {row["seed"]: row for row in rows if row["case"] == arguments.case}
    seeds = range(arguments.first, arguments.first + arguments.count)
    with tempfile.TemporaryDirectory() as folder:
        for seed in seeds:
            if seed in done:
                continue
            done[seed] = one(arguments.case, seed, Path(folder))
            print(line(done[seed]), flush=True)
            if arguments.results is not None:
                with arguments.results.open("a") as file:
                    file.write(json.dumps(done[seed]) + "\n")
    print(summary([done[seed] for seed in seeds]))


if __name__ == "__main__":
    main()
