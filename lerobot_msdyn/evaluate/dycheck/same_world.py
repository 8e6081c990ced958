"""Validation cameras in the world of a fit whose camera has poses of its own: by the recorded camera's alone."""

from dataclasses import replace

import torch

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import nearest_rotation

LEAST_WAY = 1e-3  # of a recorded camera, as a share of the validation cameras' distance, that tells a scale


def in_world_of(fitted: CameraTrack, given: CameraTrack, cameras: CameraTrack) -> CameraTrack:
    """Cameras of the world of `given`, in that of `fitted`, by the similarity between the two paths of one camera.

    As is usual where poses are estimated. Rotations are compared as such, so that a path may be straight.
    """
    if torch.equal(fitted.world_from_camera, given.world_from_camera):
        return cameras
    to, source = fitted.world_from_camera.double(), given.world_from_camera.double()
    turn = nearest_rotation((to[:, :3, :3] @ source[:, :3, :3].transpose(1, 2)).sum(0))
    places, middle = source[:, :3, 3] @ turn.T, to[:, :3, 3].mean(0)
    way, its_way = places - places.mean(0), to[:, :3, 3] - middle
    poses = cameras.world_from_camera.double().clone()
    away = poses[:, :3, 3] @ turn.T - places.mean(0)
    goes = bool(way.norm(dim=-1).max() > LEAST_WAY * away.norm(dim=-1).max())
    factor = (way * its_way).sum() / way.square().sum() if goes else 1.0
    poses[:, :3, 3] = factor * away + middle
    poses[:, :3, :3] = turn @ poses[:, :3, :3]
    return replace(cameras, world_from_camera=poses.float())
