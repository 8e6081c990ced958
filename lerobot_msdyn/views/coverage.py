"""What of a new view was recorded: in how many frames, and seen from how different a direction.

A surface of the background counts as seen if any frame of the episode (or of another that shares the background) shows
it: it is projected into the recorded camera, and must not lie behind what is visible there. What moves has the number
of frames in which each of its Gaussians was visible. The rest is uncovered: no recorded frame has shown it.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import transform_points, unproject_image
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.reconstruction.evidence import Evidence, still_frames
from lerobot_msdyn.scene.rendering import Rendering

HOLE_ALPHA = 0.5  # below this opacity there is a hole: nothing is known to be there


@dataclass(frozen=True)
class Coverage:
    """Per pixel of a new view, what is known about the surface that it shows."""

    unseen: Bool[ndarray, "h w"]  # uncovered: shown in no frame, or a hole
    angle_deg: Float32[ndarray, "h w"]  # between the new line of sight and the recorded one of the same time; 180: none
    frames_seen: Int[ndarray, "h w"]  # number of frames that show it
    empty: Bool[ndarray, "h w"]  # a hole

    @property
    def unseen_share(self) -> float:
        """Share of the pixels, 0..1, that are uncovered."""
        return float(self.unseen.mean())


def coverage_of(
    rendering: Rendering, camera: CameraTrack, times: Int[Tensor, " t"], evidence: Evidence
) -> list[Coverage]:
    """Coverage of some frames, computed on the device of the rendering and the evidence.

    Args:
        rendering: the frames, with the frames that show each moving Gaussian as its `extra`.
        camera: through which they were rendered, one pose each.
        times: the scene's frames that they show.
        evidence: what was recorded.
    """
    assert rendering.extra is not None
    camera = to_device(camera, rendering.depth.device)
    coverages = []
    for i, time in enumerate(times.tolist()):
        depth, alpha = rendering.depth[i], rendering.alpha[i]
        nearest = min(time, len(evidence.camera) - 1)
        recorded = evidence.camera.select(slice(nearest, nearest + 1))
        in_camera = unproject_image(depth, camera.intrinsics[i]).reshape(-1, 3)
        points = transform_points(camera.world_from_camera[i], in_camera)
        frames_background = still_frames(evidence, points).reshape(depth.shape)
        moving = rendering.moving[i] > 0.5 * alpha
        frames_moving = (rendering.extra[i] / rendering.moving[i].clamp(min=1e-6)).round().long()
        empty = alpha < HOLE_ALPHA
        frames = torch.where(moving, frames_moving, frames_background).masked_fill(empty, 0)
        sight = points - camera.world_from_camera[i, :3, 3]
        recorded_sight = points - recorded.world_from_camera[0, :3, 3]
        cosine = torch.nn.functional.cosine_similarity(sight, recorded_sight, dim=-1).clamp(-1, 1)
        angle = torch.rad2deg(torch.arccos(cosine)).reshape(depth.shape).masked_fill(frames == 0, 180.0)
        on_host = to_device((frames == 0, angle, frames, empty), "cpu")
        coverages.append(Coverage(*(values.numpy() for values in on_host)))
    return coverages
