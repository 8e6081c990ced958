"""What of a new view the recorded camera has seen, from how far off, and in how many frames.

What stands still counts as seen if any frame of the episode (or of another that shares its background) shows it: a
surface of the new view is carried back into the recorded one, and must not lie behind what stands there. What moves
carries the number of frames in which each of its Gaussians was to be seen.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import transform_points, unproject_image
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.reconstruction.evidence import Evidence, in_front
from lerobot_msdyn.scene.rendering import Rendering

HOLE_ALPHA = 0.5  # below this opacity nothing is known to be there


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
        still = in_front(points, recorded, evidence.depth, evidence.frames).reshape(depth.shape)
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
