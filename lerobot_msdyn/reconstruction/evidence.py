"""What the recorded camera has shown of a fitted scene, made when it is fitted, used when new views are drawn."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import project, transform_points
from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.reconstruction.background import EmptyScene, fill_depth
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.rendering import BEHIND, render_scene

SAMPLES = 12  # frames in which the moving Gaussians are looked for


@dataclass(frozen=True)
class Evidence:
    """What the recorded camera has shown of a scene."""

    camera: CameraTrack  # at the size at which the scene was fitted, one pose per frame of the scene
    depth: Float[Tensor, "h w"]  # m, of what stands still; known or guessed everywhere
    frames: Int[Tensor, "h w"]  # that show what stands still there; 0 = it was made up
    moving_frames: Float[Tensor, " m"]  # frames that show each moving Gaussian


@torch.no_grad()
def evidence_of(scene: DynamicScene, camera: CameraTrack, empty: EmptyScene) -> Evidence:
    """What `camera` has shown of a scene: of what stands still as `empty` says, of what moves as the scene says.

    It is on the device of the scene, as the camera and `empty` need not be.
    """
    visible = torch.zeros(len(scene.moving), device=scene.device)
    frames = evenly(scene.frames, SAMPLES)
    if len(scene.moving) > 0:
        for frame in frames.split(1):
            pose = to_device(camera.select(frame), scene.device)
            means = scene.at(frame).means[0, len(scene.static) :]
            depth = render_scene(scene, pose, frame).depth[0]
            visible += in_front(means, pose, depth, torch.ones_like(depth)).float()
    shown = to_device((camera, fill_depth(empty.depth), empty.seen), scene.device)
    return Evidence(*shown, visible * (scene.frames / len(frames)))


def in_front(
    points: Float[Tensor, "n 3"], camera: CameraTrack, depth: Float[Tensor, "h w"], value: Tensor
) -> Int[Tensor, " n"]:
    """Per point (m, world), the largest `value` [h,w] of the four pixels around it in a view with this depth (m).

    0 where the point is outside of the view or behind what the view shows.
    """
    height, width = depth.shape
    xy, z = project(transform_points(camera.camera_from_world[0], points), camera.intrinsics[0])
    inside = (z > 0) & (xy >= 0).all(-1) & (xy[:, 0] < width) & (xy[:, 1] < height)
    corner = (torch.nan_to_num(xy) - 0.5).floor()
    farthest, most = torch.zeros_like(z), torch.zeros_like(z)
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column = (corner[:, 0] + right).clamp(0, width - 1).long()
        row = (corner[:, 1] + down).clamp(0, height - 1).long()
        farthest = torch.maximum(farthest, depth[row, column])
        most = torch.maximum(most, value[row, column].float())
    return torch.where(inside & (z <= farthest * (1 + BEHIND)), most, 0).long()


def is_behind(evidence: Evidence, places: Float[Tensor, "n 3"]) -> bool:
    """Whether any of some places (m, world) is behind what stands still before the recorded camera."""
    camera = evidence.camera.select(slice(1))
    places = places.to(evidence.depth.device)
    xy, z = project(transform_points(camera.camera_from_world[0], places), camera.intrinsics[0])
    inside = (z > 0) & (xy >= 0).all(-1) & (xy[:, 0] < camera.width) & (xy[:, 1] < camera.height)
    column, row = xy[inside].long().unbind(-1)
    return bool((z[inside] > evidence.depth[row, column]).any())
