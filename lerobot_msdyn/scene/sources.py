"""What renders the pixels of a picture: the background, the moving set (motion), short-lived Gaussians or an overlay.

Every pixel of a picture is a blend, whose weights add up to its opacity. Rendered with one colour per kind instead of
the Gaussians' own, it tells how much of it comes from which. A pixel belongs to the kind with the largest weight.

**Moving pixels.** Where a picture is one that was recorded, a mask says which of its pixels show something that moves,
and these are counted, whatever renders them: the background may well, where motion misses a body. Of a new view there
is no mask. There a pixel is moving if the moving set and what patches show *of a mask* have more than half of its
weight. Patches mend shadows, edges and changes of light as well; what they show of pixels that the mask calls still
is not moving, however much of the picture it is.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import project, transform_points
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import Gaussians, rgb_to_sh
from lerobot_msdyn.scene.overlay import FramePatch
from lerobot_msdyn.scene.rendering import Rendering, render_patched, render_scene

MOVING_WEIGHT = 0.5  # of a new view's pixel, beyond which it counts as moving


@dataclass(frozen=True)
class MovingPixels:
    """How many moving pixels of some pictures are rendered by what."""

    motion: int = 0
    short_lived: int = 0
    overlay: int = 0
    background: int = 0  # the static set, or nothing at all: motion misses what moves there

    def __add__(self, other: "MovingPixels") -> "MovingPixels":
        return MovingPixels(*(mine + its for mine, its in zip(vars(self).values(), vars(other).values(), strict=True)))

    @property
    def total(self) -> int:
        """All moving pixels."""
        return sum(vars(self).values())

    @property
    def shares(self) -> dict[str, float]:
        """Share of each source, 0..1; all 0 where nothing moves."""
        return {f"by_{name}": count / max(self.total, 1) for name, count in vars(self).items()}


@dataclass(frozen=True)
class Sources:
    """Weights of the kinds in some pictures; they add up to the opacity."""

    motion: Float[Tensor, "t h w"]
    short_lived: Float[Tensor, "t h w"]
    overlay: Float[Tensor, "t h w"]
    background: Float[Tensor, "t h w"]

    def count(self, moving: Bool[Tensor, "t h w"]) -> MovingPixels:
        """What renders those pixels that move; of equal weights the background, then motion come first."""
        first = (self.background, self.motion, self.short_lived, self.overlay)
        winners = torch.stack(first).argmax(0)[moving]
        background, motion, short_lived, overlay = winners.bincount(minlength=len(first)).tolist()
        return MovingPixels(motion, short_lived, overlay, background)


@torch.no_grad()
def sources_of(scene: DynamicScene, camera: CameraTrack, frames: Int[Tensor, " b"], backend: str = "auto") -> Sources:
    """What renders a scene at some frames through as many poses of any camera; on the host."""
    return _sources(scene, camera, frames, lambda i, patch: patch.means.new_ones(len(patch)), backend)


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
        scene: with or without patches.
        camera: of the new view, at any size, a pose per frame.
        frames: of the scene.
        recorded: the recorded camera at these frames.
        masks: where something moves in its pictures, at its size.
        backend: of the rasterizer.
    """
    recorded, masks = to_device((recorded, masks), scene.device)

    def shows_mask(i: int, patch: FramePatch) -> Float[Tensor, " n"]:
        return _shows_mask(patch, recorded.select([i]), masks[i])

    sources = _sources(scene, camera, frames, shows_mask, backend)
    return sources.count(sources.motion + sources.short_lived + sources.overlay > MOVING_WEIGHT)


def _sources(
    scene: DynamicScene,
    camera: CameraTrack,
    frames: Int[Tensor, " b"],
    counted: Callable[[int, FramePatch], Float[Tensor, " n"]],
    backend: str,
) -> Sources:
    """Weights, those of patches as far as `counted` (the number of a frame, its patch) says, 0..1.

    Rendered with other colours: of patches, what is counted of short-lived ones is red, of an overlay green, and what
    is not counted blue; all else is black, and the share of the moving set is rendered in any case.
    """
    static, moving = _black(scene.static), _black(scene.moving)
    black = replace(scene.without_patches(), static=static, moving=moving, shading=None)

    def at(i: int, frame: int) -> Rendering:
        patch, pose = scene.patch(frame), camera.select([i])
        if patch is None:
            return render_scene(black, pose, frames[i : i + 1], backend)
        values = counted(i, patch)
        rgb = torch.zeros_like(patch.rgb)
        rgb[: patch.short_lived, 0] = values[: patch.short_lived]
        rgb[patch.short_lived :, 1] = values[patch.short_lived :]
        rgb[:, 2] = 1 - values
        return render_patched(black, pose, frame, replace(patch, rgb=rgb), backend)

    renderings = [to_device(at(i, frame), "cpu") for i, frame in enumerate(frames.tolist())]
    rgb, moved, alpha = (torch.cat([getattr(one, name) for one in renderings]) for name in ("rgb", "moving", "alpha"))
    short_lived, overlay, _ = rgb.unbind(-1)
    motion = (moved - rgb.sum(-1)).clamp(min=0)
    return Sources(motion, short_lived, overlay, (alpha - motion - short_lived - overlay).clamp(min=0))


def _black(gaussians: Gaussians) -> Gaussians:
    colours = torch.zeros(len(gaussians), 3, device=gaussians.means.device)
    return replace(gaussians, sh=rgb_to_sh(colours))


def _shows_mask(patch: FramePatch, recorded: CameraTrack, mask: Bool[Tensor, "h w"]) -> Float[Tensor, " n"]:
    """1 for the Gaussians of a patch that show recorded pixels within a mask; else 0."""
    size = torch.tensor([recorded.width - 1, recorded.height - 1], device=patch.means.device)
    in_camera = transform_points(recorded.camera_from_world[0], patch.means)
    column, row = project(in_camera, recorded.intrinsics[0])[0].floor().long().clamp(min=0).minimum(size).unbind(-1)
    return mask[row, column].float()
