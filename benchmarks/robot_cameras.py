"""How often the camera of a made-up arm is found, and how often a wrong one is believed.

python benchmarks/robot_cameras.py --count 100 [--first 0]
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "helpers"))

from filmed_arm import FPS, HEIGHT, NAMES, WIDTH, camera, pictures
from made_up_arms import swing, write_arm

from lerobot_msdyn.priors.masks.robot import RobotPictures
from lerobot_msdyn.robots import load_robot, map_joints
from lerobot_msdyn.robots.calibration.search import angle_between
from lerobot_msdyn.robots.calibration.solve import solve

FRAMES = 64
WRONG_DEG, WRONG_SHARE = 5.0, 0.15  # from which a camera is wrong


def one(seed: int, folder: Path) -> tuple[float, float, float, str]:
    """Errors of rotation (degrees), position and focal length (shares), and the doubt."""
    rng = np.random.default_rng(seed)
    robot = load_robot(write_arm(folder / str(seed), seed))
    fov = rng.uniform(35, 75)
    distance = rng.uniform(0.75, 1.1) * 0.55 / np.tan(np.radians(fov) / 2)
    pose = camera(rng.uniform(0, 360), rng.uniform(5, 75), distance, fov)
    state = swing(FRAMES, seed) + rng.normal(0, 0.2, (FRAMES, 6))
    if seed % 3 == 0:
        state[:, 0] = state[0, 0]  # the first joint rests
    frames = pictures(robot, pose, state)
    _disturb(frames, rng)
    mapping = map_joints(robot, NAMES, state)
    values = mapping.values(state)
    verdict = solve(robot, values, np.gradient(values, 1 / FPS, axis=0), RobotPictures(frames))
    found = verdict.solution.pose
    turned = np.degrees(angle_between(found.rotation, pose.rotation))
    apart = float(np.linalg.norm(found.centre - pose.centre)) / pose.distance
    return turned, apart, abs(found.focal / pose.focal - 1), verdict.doubt


def _disturb(frames: np.ndarray, rng: np.random.Generator) -> None:
    """Something else turns on its place and is drawn across the picture."""
    x, y = rng.uniform(0.15, 0.85, 2) * (WIDTH, HEIGHT)
    speed = rng.uniform(-1, 1, 2) * (WIDTH, HEIGHT) / len(frames) / 2
    colour = tuple(int(value) for value in rng.integers(0, 255, 3))
    for t, frame in enumerate(frames):
        box = ((float(x + t * speed[0]), float(y + t * speed[1])), (30.0, 14.0), 17.0 * t)
        cv2.fillPoly(frame, [cv2.boxPoints(box).astype(np.int32)], colour)


def main() -> None:
    """Print one line per camera, and the shares."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(arguments.first, arguments.first + arguments.count):
            start = time.process_time()
            turned, apart, focal, doubt = one(seed, Path(folder))
            wrong = turned > WRONG_DEG or apart > WRONG_SHARE
            rows.append((wrong, not doubt, turned, apart, focal))
            seconds = time.process_time() - start
            text = f"{seed}: {turned:.2f} deg, {apart:.1%}, focal {focal:.1%}; {seconds:.0f} s; {doubt or 'believed'}"
            print(text + (" WRONG" if wrong else ""), flush=True)
    count_wrong = sum(row[0] for row in rows)
    believed = sum(row[0] and row[1] for row in rows)
    doubted = sum(not row[0] and not row[1] for row in rows)
    right = np.array([row[2:] for row in rows if not row[0]])
    print(
        f"{len(rows)} cameras: {1 - count_wrong / len(rows):.0%} right, {believed} wrong and believed, "
        f"{doubted} right and doubted"
    )
    if len(right):
        turned, apart, focal = np.median(right, axis=0)
        print(f"medians of those that are right: {turned:.2f} deg, {apart:.2%}, focal {focal:.2%}")


if __name__ == "__main__":
    main()
