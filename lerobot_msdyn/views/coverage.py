"""What of a new view the recorded camera has seen, from how far off, and in how many frames.

What stands still counts as seen if any frame of the episode (or of another that shares its background) shows it: a
surface of the new view is carried back into the recorded one, and must not lie behind what stands there. What moves
carries the number of frames in which each of its Gaussians was to be seen.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import project, transform_points, unproject_image
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.reconstruct.background import EmptyScene, fill_depth
from lerobot_msdyn.scene.draw import BEHIND, Rendering, draw
from lerobot_msdyn.scene.gaussians import DynamicScene

HOLE_ALPHA = 0.5  # below this opacity nothing is known to be there
SAMPLES = 12  # frames in which the moving Gaussians are looked for


@dataclass(frozen=True)
class Evidence:
    """What the recorded camera has shown of a scene."""

    camera: CameraTrack  # at the size at which the scene was fitted, one pose per frame of the scene
    depth: Float[Tensor, "h w"]  # m, of what stands still; known or guessed everywhere
    frames: Int[Tensor, "h w"]  # that show what stands still there; 0 = it was made up
    moving_frames: Float[Tensor, " m"]  # frames that show each moving Gaussian


@dataclass(frozen=True)
class Coverage:
    """Per pixel of a new view, what is known about the surface that it shows."""

    unseen: Bool[ndarray, "h w"]  # in no frame, or there is nothing
    angle_deg: Float32[ndarray, "h w"]  # between the new line of sight and the recorded one of the same time; 180: none
    frames_seen: Int[ndarray, "h w"]  # frames that show it
    empty: Bool[ndarray, "h w"]  # nothing is there

    @property
    def unseen_share(self) -> float:
        """Share of the pixels, 0..1, that are unseen."""
        return float(self.unseen.mean())


@torch.no_grad()
def evidence_of(scene: DynamicScene, camera: CameraTrack, empty: EmptyScene) -> Evidence:
    """What `camera` has shown of a scene: of what stands still as `empty` says, of what moves as the scene says.

    It is on the device of the scene, as the camera and `empty` need not be.
    """
    visible = torch.zeros(len(scene.moving), device=scene.device)
    frames = torch.linspace(0, scene.frames - 1, min(scene.frames, SAMPLES)).round().long()
    if len(scene.moving) > 0:
        for frame in frames.split(1):
            pose = to_device(camera.select(frame), scene.device)
            means = scene.at(frame).means[0, len(scene.static) :]
            depth = draw(scene, pose, frame).depth[0]
            visible += _in_front(means, pose, depth, torch.ones_like(depth)).float()
    shown = to_device((camera, fill_depth(empty.depth), empty.seen), scene.device)
    return Evidence(*shown, visible * (scene.frames / len(frames)))


def coverage_of(
    rendering: Rendering, camera: CameraTrack, times: Int[Tensor, " t"], evidence: Evidence
) -> list[Coverage]:
    """Coverage of some frames, computed on the device of the rendering and the evidence.

    Args:
        rendering: the frames, with the frames that show each moving Gaussian as its `extra`.
        camera: through which they were drawn, one pose each.
        times: the scene's frames that they show.
        evidence: what was recorded.
    """
    assert rendering.extra is not None
    camera, found = to_device(camera, rendering.depth.device), []
    for i, time in enumerate(times.tolist()):
        depth, alpha = rendering.depth[i], rendering.alpha[i]
        nearest = min(time, len(evidence.camera) - 1)
        recorded = evidence.camera.select(slice(nearest, nearest + 1))
        in_camera = unproject_image(depth, camera.intrinsics[i]).reshape(-1, 3)
        points = transform_points(camera.world_from_camera[i], in_camera)
        still = _in_front(points, recorded, evidence.depth, evidence.frames).reshape(depth.shape)
        moving = rendering.moving[i] > 0.5 * alpha
        seen_moving = (rendering.extra[i] / rendering.moving[i].clamp(min=1e-6)).round().long()
        empty = alpha < HOLE_ALPHA
        frames = torch.where(moving, seen_moving, still).masked_fill(empty, 0)
        sight = points - camera.world_from_camera[i, :3, 3]
        recorded_sight = points - recorded.world_from_camera[0, :3, 3]
        cosine = torch.nn.functional.cosine_similarity(sight, recorded_sight, dim=-1).clamp(-1, 1)
        angle = torch.rad2deg(torch.arccos(cosine)).reshape(depth.shape).masked_fill(frames == 0, 180.0)
        on_host = to_device((frames == 0, angle, frames, empty), "cpu")
        found.append(Coverage(*(values.numpy() for values in on_host)))
    return found


def _in_front(
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
