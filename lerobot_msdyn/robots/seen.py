"""What a calibrated camera sees of a robot."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import transform_points
from lerobot_msdyn.core.observations import BodyTracks, Model, RobotSeen
from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.robots.calibration.contours import Posed
from lerobot_msdyn.robots.calibration.record import RobotRecord
from lerobot_msdyn.robots.calibration.search import Pose
from lerobot_msdyn.robots.description import Robot

LEAST_MOTION = np.radians(1.5)  # of a joint that moves
POINTS = 80  # of each link
SAME_SURFACE = 0.01  # share of its depth by which a point of the surface may miss what is drawn


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
    bodies = _bodies(posed, moves, pose, depth)
    return RobotSeen(torch.from_numpy(depth), torch.from_numpy(moving), bodies, ground, model)


def through(seen: RobotSeen, told: CameraTrack, known: CameraTrack) -> RobotSeen:
    """What a robot's joints say of a video whose true camera is known: in its world, each point at the same pixel.

    Where the camera that the joints tell has another focal length, its distances are off by the same factor.

    Args:
        seen: as the joints tell it.
        told: the fixed camera that they tell.
        known: the true one, fixed as well.
    """
    factor = known.intrinsics[0, 0, 0] / told.intrinsics[0, 0, 0]
    to_known = factor * torch.linalg.inv(known.intrinsics[0]) @ told.intrinsics[0]

    def moved(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        in_camera = transform_points(told.camera_from_world[0], points) @ to_known.T
        return transform_points(known.world_from_camera[0], in_camera)

    pose = told.world_from_camera[0]
    ahead = (seen.ground_m - pose[2, 3]) / pose[2, 2].clamp(max=-1e-3)  # along the line of sight, to the ground
    ground = moved((pose[:3, 3] + ahead * pose[:3, 2])[None])[0, 2]
    xyz = moved(seen.bodies.xyz.flatten(0, 1)).reshape(seen.bodies.xyz.shape)
    bodies = replace(seen.bodies, xyz=xyz)
    return replace(seen, depth=factor * seen.depth, bodies=bodies, ground_m=float(ground))


def _bodies(posed: Posed, moves: Bool[ndarray, " l"], pose: Pose, depth: Float32[ndarray, "t h w"]) -> BodyTracks:
    """Points of the surface of every link that moves, in the robot's frame."""
    robot, (height, width) = posed.robot, depth.shape[1:]
    points, body, xyz = [], [], []
    for link in np.flatnonzero(moves):
        own = np.flatnonzero(robot.point_link == link)
        own = own[evenly(len(own), POINTS).numpy()]
        if len(own):
            points.append(own)
            body += [len(points) - 1] * len(own)
            turned = robot.points[own] @ posed.links[:, link, :3, :3].transpose(0, 2, 1)
            xyz.append(turned + posed.links[:, link, None, :3, 3])
    if not xyz:
        return BodyTracks(torch.zeros(0, len(posed), 3), torch.zeros(0, len(posed)) > 0, torch.zeros(0).long())
    world = np.concatenate(xyz, axis=1)
    in_camera = world @ pose.rotation.T + pose.translation
    z = in_camera[..., 2].clip(min=1e-6)
    column, row = (
        np.floor(in_camera[..., axis] / z * pose.focal * width + size / 2).astype(int)
        for axis, size in ((0, width), (1, height))
    )
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (in_camera[..., 2] > 0)
    seen = depth[np.arange(len(depth))[:, None], row.clip(0, height - 1), column.clip(0, width - 1)]
    visible = inside & (seen > 0) & (np.abs(seen - z) < SAME_SURFACE * z)
    return BodyTracks(
        torch.from_numpy(world.transpose(1, 0, 2).astype(np.float32)),
        torch.from_numpy(visible.T.copy()),
        torch.tensor(body),
    )
