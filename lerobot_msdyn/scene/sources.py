"""What renders the pixels of a picture: the background, the moving set (motion) or an overlay (recorded pixels).

Every pixel of a picture is a blend, whose weights add up to its opacity. Rendered with one colour per set instead of
the Gaussians' own, it tells how much of it comes from which. A pixel belongs to the set with the largest weight.

**Moving pixels.** Where a picture is one that was recorded, a mask says which of its pixels show something that moves,
and these are counted, whatever renders them: the background may well, where motion misses a body. Of a new view there
is no mask. There a pixel is moving if the moving set and what an overlay shows *of a mask* have more than half of its
weight. Overlays mend shadows, edges and changes of light as well; what they show of pixels that the mask calls still
is not moving, however much of the picture it is.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import project, transform_points
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import Gaussians, rgb_to_sh
from lerobot_msdyn.scene.overlay import Overlay
from lerobot_msdyn.scene.rendering import render_scene

MOVING_WEIGHT = 0.5  # of a new view's pixel, beyond which it counts as moving


@dataclass(frozen=True)
class MovingPixels:
    """How many moving pixels of some pictures are rendered by what."""

    motion: int = 0
    overlay: int = 0
    background: int = 0  # the static set, or nothing at all: motion misses what moves there

    def __add__(self, other: "MovingPixels") -> "MovingPixels":
        return MovingPixels(
            self.motion + other.motion, self.overlay + other.overlay, self.background + other.background
        )

    @property
    def total(self) -> int:
        """All moving pixels."""
        return self.motion + self.overlay + self.background

    @property
    def shares(self) -> dict[str, float]:
        """Share of each source, 0..1; all 0 where nothing moves."""
        return {f"by_{name}": count / max(self.total, 1) for name, count in vars(self).items()}


@dataclass(frozen=True)
class Sources:
    """Weights of the sets in some pictures; they add up to the opacity."""

    motion: Float[Tensor, "t h w"]
    overlay: Float[Tensor, "t h w"]
    background: Float[Tensor, "t h w"]

    def count(self, moving: Bool[Tensor, "t h w"]) -> MovingPixels:
        """What renders those pixels that move."""
        by_overlay = (self.overlay > self.motion) & (self.overlay > self.background)
        by_motion = ~by_overlay & (self.motion > self.background)
        motion, overlay = (int((moving & pixels).sum()) for pixels in (by_motion, by_overlay))
        return MovingPixels(motion, overlay, int(moving.sum()) - motion - overlay)


@torch.no_grad()
def sources_of(scene: DynamicScene, camera: CameraTrack, frames: Int[Tensor, " b"], backend: str = "auto") -> Sources:
    """What renders a scene at some frames through as many poses of any camera; on the host."""
    motion, overlay, _, background = _weights(_by_source(scene), camera, frames, backend)
    return Sources(motion, overlay, background)


@torch.no_grad()
def moving_pixels_of_view(
    scene: DynamicScene,
    camera: CameraTrack,
    frames: Int[Tensor, " b"],
    recorded: CameraTrack,
    masks: Bool[Tensor, "b h w"],
    backend: str = "auto",
) -> MovingPixels:
    """What renders the moving pixels of a new view, of which there is no mask.

    Args:
        scene: with or without an overlay.
        camera: of the new view, at any size, a pose per frame.
        frames: of the scene.
        recorded: the recorded camera at these frames.
        masks: where something moves in its pictures, at its size.
        backend: of the rasterizer.
    """
    overlay = scene.overlay
    shows_mask = None if overlay is None else _shows_mask(overlay, frames, recorded, masks)
    motion, _, of_mask, background = _weights(_by_source(scene, shows_mask), camera, frames, backend)
    return Sources(motion, of_mask, background).count(motion + of_mask > MOVING_WEIGHT)


def _by_source(scene: DynamicScene, shows_mask: Float[Tensor, " n"] | None = None) -> DynamicScene:
    """The scene with other colours: what moves is red, overlays are green, and blue too where they show a mask."""
    overlay = scene.overlay
    if overlay is not None:
        values = torch.zeros_like(overlay.rgb)
        values[:, 1] = 1
        if shows_mask is not None:
            values[:, 2] = shows_mask.to(values)
        overlay = replace(overlay, rgb=values)
    static, moving = _coloured(scene.static, (0.0, 0.0, 0.0)), _coloured(scene.moving, (1.0, 0.0, 0.0))
    return replace(scene, static=static, moving=moving, shading=None, overlay=overlay)


def _coloured(gaussians: Gaussians, rgb: tuple[float, float, float]) -> Gaussians:
    colours = torch.tensor(rgb, device=gaussians.means.device).expand(len(gaussians), 3)
    return replace(gaussians, sh=rgb_to_sh(colours))


def _weights(
    scene: DynamicScene, camera: CameraTrack, frames: Int[Tensor, " b"], backend: str
) -> tuple[Float[Tensor, "t h w"], ...]:
    """Weights of motion, overlay, overlay that shows a mask, and background, of a scene that is coloured by source."""
    rendering = to_device(render_scene(scene, camera, frames, backend), "cpu")
    motion, overlay, of_mask = rendering.rgb.unbind(-1)
    return motion, overlay, of_mask, (rendering.alpha - motion - overlay).clamp(min=0)


def _shows_mask(
    overlay: Overlay, frames: Int[Tensor, " b"], recorded: CameraTrack, masks: Bool[Tensor, "b h w"]
) -> Float[Tensor, " n"]:
    """1 for the Gaussians of an overlay, at some frames, that show recorded pixels within the mask; else 0."""
    values = torch.zeros(len(overlay.means), device=overlay.means.device)
    recorded, masks = to_device((recorded, masks), values.device)
    size = torch.tensor([recorded.width - 1, recorded.height - 1], device=values.device)
    for i, frame in enumerate(frames.tolist()):
        rows = overlay.rows(frame)
        in_camera = transform_points(recorded.camera_from_world[i], overlay.means[rows])
        column, row = project(in_camera, recorded.intrinsics[i])[0].floor().long().clamp(min=0).minimum(size).unbind(-1)
        values[rows] = masks[i, row, column].float()
    return values
