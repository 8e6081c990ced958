"""What a calibrated camera sees of a robot."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.observations import Model, RobotSeen
from lerobot_msdyn.robots.calibration.contours import Posed
from lerobot_msdyn.robots.calibration.record import RobotRecord
from lerobot_msdyn.robots.calibration.search import Pose
from lerobot_msdyn.robots.description import Robot

LEAST_MOTION = np.radians(1.5)  # of a joint that moves


def robot_seen(
    robot: Robot, record: RobotRecord, state: Float[Tensor, "t s"], fps: int | float, camera: CameraTrack, where: Path
) -> RobotSeen:
    """Depth of the links in every frame of an episode, which of them move, and the ground.

    Args:
        robot: the robot of the calibration.
        record: how its joints follow from the state.
        state: of the episode.
        fps: frames per second.
        camera: a fixed one, in the robot's frame.
        where: the calibration file, for messages.

    Raises:
        PriorError: the calibration is of another robot or state.
    """
    record.check(robot, state.shape[1], where)
    values = record.values(state.numpy(), float(fps))
    posed = Posed(robot, values)
    moves = (robot.moved_by & (np.ptp(values, axis=0) > LEAST_MOTION)).any(1)
    view = camera.camera_from_world[0].double().numpy()
    pose = Pose(view[:3, :3], view[:3, 3], float(camera.intrinsics[0, 0, 0]) / camera.width)
    depth = np.zeros((len(values), camera.height, camera.width), np.float32)
    moving = np.zeros(depth.shape, bool)
    for frame in range(len(values)):
        depth[frame], link = posed.drawn(frame, pose, camera.width, camera.height)
        moving[frame] = (link >= 0) & moves[link]
    root = robot.vertices[np.unique(robot.faces[~robot.moved_by[robot.face_link].any(1)])]
    ground = float(root[:, 2].min()) if len(root) else 0.0
    model = Model(robot.name, licence=robot.licence)
    return RobotSeen(torch.from_numpy(depth), torch.from_numpy(moving), ground, model)
