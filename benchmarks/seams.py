"""How far pictures jump where one window of a long episode ends and the next begins, in what stands still."""

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import Fill
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.scene.rendering import render_frames
from lerobot_msdyn.views.pictures import new_pictures

AROUND = 12  # frames before and after a seam
STILL = 0.02  # share of the moving set in a pixel, in all of these frames, up to which it stands still


@dataclass(frozen=True)
class Jump:
    """Mean change of what stands still from one frame to the next: at a seam, and usually (the median around it)."""

    at_seam: float
    usual: float


@dataclass(frozen=True)
class Seam:
    """One seam of a new view."""

    frame: int  # the first of the later window
    brightness: Jump  # grey levels of 255
    depth: Jump  # % of the look-at distance

    def __str__(self) -> str:
        grey, depth = self.brightness, self.depth
        return (
            f"seam at frame {self.frame}: {grey.at_seam:.2f} grey levels (usually {grey.usual:.2f}), "
            f"depth {depth.at_seam:.3f} % (usually {depth.usual:.3f} %)"
        )


def jump(values: Float[Tensor, "t h w *c"], still: Bool[Tensor, "h w"], seam: int) -> Jump:
    """That of values of frames, of which number `seam` is the first of the later window."""
    changes = [float((after - before)[still].abs().mean()) for before, after in itertools.pairwise(values)]
    at_seam = changes.pop(seam - 1)
    return Jump(at_seam, float(np.median(changes)))


def seams(scene: Reconstruction, camera: CameraTrack, fill: Fill) -> list[Seam]:
    """All seams of a new view, whose camera has one pose per frame of the episode."""
    found = []
    for window in scene.windows[1:]:
        first = max(0, window.start - AROUND)
        frames = torch.arange(first, min(window.start + AROUND, len(scene.camera)))
        renderings = [
            rendering
            for part, times in scene.stretches(frames)
            for rendering in render_frames(part.scene, camera.select(frames[times]), frames[times] - part.start)
        ]
        depth = torch.cat([rendering.depth for rendering in renderings])
        still = (torch.cat([rendering.moving for rendering in renderings]) < STILL).all(0)
        pictures = new_pictures(scene, camera.select(frames), frames, fill=fill)
        rgb = torch.from_numpy(np.stack([picture.rgb for picture in pictures])).float()
        found.append(
            Seam(
                window.start,
                jump(rgb, still, window.start - first),
                jump(100 * depth / scene.distance, still & (depth > 0).all(0), window.start - first),
            )
        )
    return found
