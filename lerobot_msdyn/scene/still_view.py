"""What stands still in a scene before a camera that does: projected once, shown in many pictures."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.render import Backdrop, Painted, project_backdrop
from lerobot_msdyn.scene.gaussians import Gaussians
from lerobot_msdyn.scene.shading import Shading


@dataclass(frozen=True)
class StillView:
    """A static set as it was when it was projected, without gradients; its brightness changes over time."""

    backdrop: Backdrop
    rgb: Float[Tensor, "s 3"]  # 0..1, before brightness
    shading: Shading | None  # none: it does not change

    def at(self, frames: Float[Tensor, " b"] | Int[Tensor, " b"]) -> Painted:
        """As some frames show it, with nothing hidden."""
        one = torch.ones_like(self.rgb[:, 0])
        gains = one if self.shading is None else self.shading.static_gain(frames)
        return Painted(self.backdrop, self.rgb, gains, torch.zeros_like(one, dtype=torch.bool))


@torch.no_grad()
def still_view(
    static: Gaussians,
    shading: Shading | None,
    camera: CameraTrack,
    near: float,
    backend: str = "auto",
    *,
    once: bool = False,
) -> StillView:
    """A static set before the first pose of a camera, on one device; for `once` or for many pictures.

    What is nearer than `near` (m) is left out.
    """
    gaussians = (static.means, static.quats, static.scales, static.opacity_logits.sigmoid())
    camera_from_world, intrinsics = camera.camera_from_world[0], camera.intrinsics[0]
    size = (camera.width, camera.height)
    backdrop = project_backdrop(*gaussians, camera_from_world, intrinsics, *size, near=near, backend=backend, once=once)
    return StillView(backdrop, static.rgb, shading)
