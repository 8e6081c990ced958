"""What the recorded camera has shown of a fitted scene, made when it is fitted, used when new views are drawn."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack, concatenated
from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.core.visibility import TOLERANCE, projected
from lerobot_msdyn.reconstruction.background import fill_depth
from lerobot_msdyn.reconstruction.key_views import KeyView
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.rendering import render_scene

SAMPLES = 12  # frames in which the moving Gaussians are looked for


@dataclass(frozen=True)
class Evidence:
    """What the recorded camera has shown of a scene."""

    camera: CameraTrack  # at the size at which the scene was fitted, one pose per frame of the scene
    keys: CameraTrack  # places from which all that stands still is seen, at the same size; one of a fixed camera
    depth: Float[Tensor, "k h w"]  # m, of what stands still, from each; known or guessed everywhere
    frames: Int[Tensor, "k h w"]  # that show what stands still there; 0 = filled from around
    moving_frames: Float[Tensor, " m"]  # frames that show each moving Gaussian

    @cached_property
    def corners(self) -> tuple[Float[Tensor, "k H W"], Int[Tensor, "k H W"]]:
        """Per corner of a pixel the largest depth, and the most frames, of the pixels that meet there."""
        return _largest_of_four(self.depth), _largest_of_four(self.frames.float()).long()


@torch.no_grad()
def evidence_of(scene: DynamicScene, camera: CameraTrack, keys: Sequence[KeyView]) -> Evidence:
    """What `camera` has shown of a scene: of what stands still as the key views say, of what moves as the scene says.

    It is on the device of the scene, as the camera and the key views need not be.
    """
    visible = torch.zeros(len(scene.moving), device=scene.device)
    frames = evenly(scene.frames, SAMPLES)
    if len(scene.moving) > 0:
        for frame in frames.split(1):
            pose = to_device(camera.select(frame), scene.device)
            means = scene.at(frame).means[0, len(scene.static) :]
            depth = render_scene(scene, pose, frame).depth[0]
            visible += in_front(means, pose, depth, torch.ones_like(depth)).float()
    depth = torch.stack([fill_depth(key.empty.depth) for key in keys])
    seen = torch.stack([key.empty.seen for key in keys])
    shown = to_device((camera, concatenated([key.camera for key in keys]), depth, seen), scene.device)
    return Evidence(*shown, visible * (scene.frames / len(frames)))


def in_front(
    points: Float[Tensor, "n 3"], camera: CameraTrack, depth: Float[Tensor, "h w"], value: Tensor
) -> Int[Tensor, " n"]:
    """Per point (m, world), the largest `value` [h,w] of the four pixels around it in a view with this depth (m).

    0 where the point is outside of the view or behind what the view shows.
    """
    return _at_corners(points, camera, _largest_of_four(depth[None])[0], _largest_of_four(value.float()[None])[0])


def _at_corners(
    points: Float[Tensor, "n 3"], camera: CameraTrack, farthest: Float[Tensor, "H W"], most: Shaped[Tensor, "H W"]
) -> Int[Tensor, " n"]:
    """`in_front`, given the largest depth and value at each corner of a pixel."""
    seen = projected(points, camera)
    column, row = (torch.nan_to_num(seen.xy) + 0.5).long().unbind(-1)
    around = row.clamp(0, camera.height), column.clamp(0, camera.width)
    return torch.where(seen.inside & (seen.z <= farthest[around] * (1 + TOLERANCE)), most[around], 0).long()


def _largest_of_four(images: Float[Tensor, "k h w"]) -> Float[Tensor, "k h+1 w+1"]:
    """The largest value of the pixels that meet at each corner of a pixel."""
    padded = torch.nn.functional.pad(images[:, None], (1, 1, 1, 1), mode="replicate")
    return torch.nn.functional.max_pool2d(padded, 2, stride=1)[:, 0]


def still_frames(evidence: Evidence, points: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    """Number of frames that show each of some surface points (m, world) of what stands still."""
    corners = zip(*evidence.corners, strict=True)
    seen = [_at_corners(points, evidence.keys.select([i]), *at) for i, at in enumerate(corners)]
    return torch.stack(seen).amax(0)


def is_behind(evidence: Evidence, places: Float[Tensor, "n 3"]) -> bool:
    """Whether any of some places (m, world) is behind what stands still, from wherever the recorded camera saw it."""
    places = places.to(evidence.depth.device)
    inside, hidden = torch.zeros(2, len(places), dtype=torch.long, device=places.device)
    for i, depth in enumerate(evidence.depth):
        seen = projected(places, evidence.keys.select([i]))
        inside += seen.inside
        hidden += seen.inside & (seen.z > depth[seen.pixel])
    return bool(((inside > 0) & (hidden == inside)).any())
