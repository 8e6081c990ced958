"""A dataset of a made-up arm in front of a textured table, as a fixed camera sees it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from made_up_arms import swing

from lerobot_msdyn.robots import Robot, map_joints
from lerobot_msdyn.robots.calibration.contours import Posed
from lerobot_msdyn.robots.calibration.search import Pose, looking_at

WIDTH, HEIGHT, FPS = 160, 120, 10
NAMES = ("pan", "lift", "elbow", "wrist", "roll", "gripper")
FRONT = "observation.images.front"


def camera(azimuth: float, elevation: float, distance: float, fov: float) -> Pose:
    """A camera that looks at the middle of the arm (degrees, m)."""
    rotation = looking_at(np.radians(azimuth), np.radians(elevation))
    target = np.array([0.05, 0.0, 0.15])
    return Pose(rotation, np.array([0.0, 0, distance]) - rotation @ target, 0.5 / float(np.tan(np.radians(fov) / 2)))


def pictures(robot: Robot, pose: Pose, state: np.ndarray) -> np.ndarray:
    """The arm in plain colours before a texture, [t, h, w, 3]."""
    posed = Posed(robot, map_joints(robot, NAMES, state).values(state))
    rng = np.random.default_rng(0)
    ground = cv2.resize(rng.integers(60, 160, (24, 32, 3), np.uint8), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    colours = rng.integers(0, 256, (len(robot.links), 3)) // 4 + np.array([190, 120, 0])
    out = []
    for frame in range(len(state)):
        _, link = posed.drawn(frame, pose, WIDTH, HEIGHT)
        painted = np.where((link >= 0)[..., None], colours[link], ground)
        out.append((painted + rng.normal(0, 2, painted.shape)).clip(0, 255).astype(np.uint8))
    return np.stack(out)


def write_filmed(
    root: Path,
    robot: Robot,
    pose: Pose,
    episodes: int = 2,
    frames: int = 24,
    names: tuple[str, ...] = NAMES,
    moved_px: Sequence[tuple[int, int]] = (),
    others: Mapping[str, Pose] = MappingProxyType({}),
) -> Path:
    """Episodes of the arm swinging, seen by a camera and by others.

    `moved_px` are those by which pictures begin and end to the side, by episode.
    """
    picture = {"dtype": "image", "shape": (HEIGHT, WIDTH, 3), "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create(
        "local/arm",
        FPS,
        {
            "observation.state": {"dtype": "float32", "shape": (6,), "names": list(names)},
            "action": {"dtype": "float32", "shape": (6,), "names": list(names)},
            **{key: dict(picture) for key in (FRONT, *others)},
        },
        root=root,
        robot_type="so101_follower",
        use_videos=False,
    )
    for episode in range(episodes):
        state = swing(frames, episode).astype(np.float32)
        begins, ends = moved_px[episode] if moved_px else (0, 0)
        seen = {key: pictures(robot, each, state) for key, each in {FRONT: pose, **others}.items()}
        for t, row in enumerate(state):
            shifted = {key: np.roll(of[t], begins if t < frames // 2 else ends, axis=1) for key, of in seen.items()}
            dataset.add_frame({"observation.state": row, "action": row, "task": "swing"} | shifted)
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root
