"""The poses of a camera that rides on a link of the robot, by the joints and by how the ground goes by in its video."""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from lerobot.datasets import LeRobotDatasetMetadata
from numpy import ndarray

from lerobot_msdyn.augment.robot_cameras import described, joints_of, small_pictures, states_of
from lerobot_msdyn.core.config import RobotConfig
from lerobot_msdyn.core.errors import ConfigError, DatasetError, EpisodeError
from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.dataset.checks import picture_size
from lerobot_msdyn.dataset.rows import read_rows
from lerobot_msdyn.priors.exchange import Exchange, write_exchange
from lerobot_msdyn.robots.calibration.hand_eye import HandEye, solve_hand_eye
from lerobot_msdyn.robots.kinematics import link_poses

WORLD = "robot"  # its root, in all episodes
FRAMES = 400  # of each episode that is looked at, from its first one


@dataclass(frozen=True)
class RidingCamera:
    """A camera on a link, and the link's poses in all episodes."""

    key: str
    link: str
    eye: HandEye  # its focal length is of pictures `width` wide
    width: int  # px
    fps: int | float
    world_from_link: dict[int, Float64[ndarray, "t 4 4"]]  # by episode; the world is the robot's root

    def __str__(self) -> str:
        fov = math.degrees(2 * math.atan(self.width / 2 / self.eye.focal_px))
        away = float(np.linalg.norm(self.eye.link_from_camera[:3, 3]))
        return (
            f"{self.key} on {self.link}: {away:.3f} m from its origin, field of view {fov:.1f} degrees, joints "
            f"{self.eye.lag_s:+.2f} s after the pictures; corners of the ground lie {self.eye.error_px:.1f} px of "
            f"{self.width} from where they should (median)"
        )

    def write(self, source: LeRobotDatasetMetadata, folder: Path) -> Iterator[Path]:
        """An exchange file with K and poses for each episode (docs/priors.md)."""
        height, width, _ = picture_size(source.features[self.key])
        focal = self.eye.focal_px * width / self.width
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
        for index, links in self.world_from_link.items():
            poses = np.linalg.inv(self.eye.poses(links, self.fps)).astype(np.float32)
            path = folder / f"episode_{index:06d}" / f"{self.key}.npz"
            content = Exchange(
                len(poses), height, width, index, self.key, K=np.tile(K, (len(poses), 1, 1)), w2c=poses, world=WORLD
            )
            write_exchange(path, content)
            yield path


def riding_camera(
    source: LeRobotDatasetMetadata,
    key: str,
    link: str,
    episodes: Sequence[int],
    config: RobotConfig,
    max_episodes: int,
) -> RidingCamera:
    """Where a camera sits on a link, by some of the episodes, and the poses of the link in all of them.

    Raises:
        ConfigError: the robot's description cannot be had, has no such link, or the state is not that of its joints.
        DatasetError: there is no state, or no episode can be read.
        PriorError: the video does not tell where the camera is.
    """
    robot = described(source, config)
    if link not in robot.links:
        raise ConfigError(f"--link {link!r}: {robot.name} has no such link; expected one of {', '.join(robot.links)}")
    states = states_of(source, episodes)
    mapping = joints_of(source, robot, states, config)
    index = robot.links.index(link)
    poses = {
        episode: link_poses(robot, torch.from_numpy(mapping.values(state))).numpy()[:, index]
        for episode, state in states.items()
    }
    known = list(poses)
    videos, links = [], []
    for episode in (known[int(k)] for k in evenly(len(known), max_episodes)):
        with contextlib.suppress(EpisodeError):
            rows = read_rows(source, episode)
            videos.append(np.stack(small_pictures(source, episode, key, rows, range(min(len(rows), FRAMES)))))
            links.append(poses[episode][: len(videos[-1])])
    if not videos:
        raise DatasetError(f"{source.repo_id}: the video of {key} can be read in no episode")
    eye = solve_hand_eye(videos, links, source.fps)
    return RidingCamera(key, link, eye, videos[0].shape[2], source.fps, poses)
