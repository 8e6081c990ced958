"""What of a new view was recorded: in how many frames, and seen from how different a direction.

A surface of the background counts as seen if any frame of the episode (or of another that shares the background) shows
it: it is projected into the recorded camera, and must not lie behind what is visible there. What moves has the number
of frames in which each of its Gaussians was visible. The rest is uncovered: no recorded frame has shown it.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import transform_points, unproject_image
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.core.visibility import TOLERANCE
from lerobot_msdyn.reconstruction.evidence import Evidence, still_frames
from lerobot_msdyn.scene.rendering import Rendering
from lerobot_msdyn.views.kernels import look_up

HOLE_ALPHA = 0.5  # below this opacity there is a hole: nothing is known to be there


@dataclass(frozen=True)
class Coverage:
    """Per pixel of a new view, what is known about the surface that it shows."""

    unseen: Bool[ndarray, "h w"]  # uncovered: shown in no frame, or a hole
    frames_seen: Int[ndarray, "h w"]  # number of frames that show it
    empty: Bool[ndarray, "h w"]  # a hole

    @property
    def unseen_share(self) -> float:
        """Share of the pixels, 0..1, that are uncovered."""
        return float(self.unseen.mean())


@dataclass(frozen=True)
class Looked:
    """What has been looked up of one picture of a fixed camera: less is left to look up of the next one."""

    depth: Float[Tensor, "h w"]  # m
    still: Int[Tensor, "h w"]  # frames that show what stands still at that depth


def coverage_of(
    rendering: Rendering, camera: CameraTrack, evidence: Evidence, before: Looked | None = None
) -> list[Coverage]:
    """Coverage of some frames, computed on the device of the rendering and the evidence.

    Args:
        rendering: the frames, with the frames that show each moving Gaussian as its `extra`.
        camera: through which they were rendered, one pose each.
        evidence: what was recorded.
        before: of the first pose, if the camera is a fixed one.
    """
    assert rendering.extra is not None
    device = rendering.depth.device
    holds = camera.is_static
    camera = to_device(camera, device)
    shown, holes = [], []
    for i, (depth, alpha) in enumerate(zip(rendering.depth, rendering.alpha, strict=True)):
        before = looked(depth, camera.select([i]), evidence, before if holds else None)
        moving = rendering.moving[i] > 0.5 * alpha
        frames_moving = (rendering.extra[i] / rendering.moving[i].clamp(min=1e-6)).round().long()
        empty = alpha < HOLE_ALPHA
        shown.append(torch.where(moving, frames_moving, before.still).masked_fill(empty, 0))
        holes.append(empty)
    on_host = (values.numpy() for values in to_device((torch.stack(shown), torch.stack(holes)), "cpu"))
    return [Coverage(frames == 0, frames, empty) for frames, empty in zip(*on_host, strict=True)]


def looked(depth: Float[Tensor, "h w"], pose: CameraTrack, evidence: Evidence, before: Looked | None = None) -> Looked:
    """Looks up what stands still in a picture: on a CPU only what differs from one that was looked up before."""
    if depth.device.type != "cpu":  # where to look for what differs costs more than it spares
        return Looked(depth, still_frames(evidence, _points(depth, pose)).reshape(depth.shape))
    if before is None:
        before = Looked(torch.full_like(depth, torch.nan), torch.zeros(depth.shape, dtype=torch.long))
    still = before.still.clone()
    maps, offsets = _to_keys(pose, evidence.keys)
    arrays = (depth, before.depth, maps, offsets, *evidence.corners)
    look_up(*(values.contiguous().numpy() for values in arrays), TOLERANCE, still.numpy())
    return Looked(depth, still)


def _to_keys(pose: CameraTrack, keys: CameraTrack) -> tuple[Float[Tensor, "k 3 3"], Float[Tensor, "k 3"]]:
    """From pixels (x, y, 1) of a camera at 1 m to (x z, y z, z) of each key view, and what is added to that."""
    key_from_camera = keys.camera_from_world.double() @ pose.world_from_camera[0].double()
    K = keys.intrinsics.double()
    maps = K @ key_from_camera[:, :3, :3] @ torch.linalg.inv(pose.intrinsics[0].double())
    return maps, (K @ key_from_camera[:, :3, 3:])[..., 0]


def angles_of(depth: Float[Tensor, "h w"], camera: CameraTrack, recorded: CameraTrack) -> Float32[ndarray, "h w"]:
    """Angles (degrees) between the line of sight to what a pixel shows and that of the recorded camera to the same.

    All on the host.

    Args:
        depth: m, through the first pose of `camera`.
        camera: the new one.
        recorded: the other one, whose first pose counts.
    """
    points = _points(depth, camera)
    new, old = (points - one.world_from_camera[0, :3, 3] for one in (camera, recorded))
    cosine = torch.nn.functional.cosine_similarity(new, old, dim=-1).clamp(-1, 1)
    return torch.rad2deg(torch.arccos(cosine)).reshape(depth.shape).numpy()


def _points(depth: Float[Tensor, "h w"], camera: CameraTrack) -> Float[Tensor, "n 3"]:
    """What the pixels show (m, world) through the first pose of a camera."""
    in_camera = unproject_image(depth, camera.intrinsics[0]).reshape(-1, 3)
    return transform_points(camera.world_from_camera[0], in_camera)
