"""Moving Gaussians that the video contradicts are taken out of a fitted scene."""

import logging

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.core.visibility import projected
from lerobot_msdyn.render.cpu.threads import each_on
from lerobot_msdyn.scene.dynamic import DynamicScene, Snapshot
from lerobot_msdyn.scene.rendering import render_snapshot

logger = logging.getLogger(__name__)

SAMPLES = 40  # frames that are compared
COLOUR_ERROR = 0.08  # mean absolute difference of colours 0..1, to the most similar of nine pixels
MOST_WRONG = 0.4  # share of the frames in which it is to be seen in which a Gaussian may have another colour


@torch.no_grad()
def without_contradicted(scene: DynamicScene, view: View) -> DynamicScene:
    """The scene without those of the moving set that have another colour than the video where they are to be seen.

    Where depth is not recorded, points that follow the motion of another body than their own are not contradicted by
    depth; they are specks of its colour on the other. A Gaussian is compared with the pixel onto which it is projected
    and those beside it, as edges are a pixel wide; where the picture is right there, it is not held against a Gaussian
    that its own colour is another, as those of fine texture, which blend, may be.

    Args:
        scene: fitted, without patches.
        view: the video, at the size at which it was fitted.
    """
    count = len(scene.moving)
    if count == 0:
        return scene
    frames, still = evenly(len(view), SAMPLES), scene.still_before(view.camera)

    def compared(frame: Int[Tensor, "1"]) -> tuple[Bool[Tensor, " m"], Bool[Tensor, " m"]]:
        camera = to_device(view.camera.select(frame), scene.device)
        backdrop = None if still is None else still.at(frame)
        snapshot = scene.at(frame, camera.world_from_camera[:, :3, 3], backdrop)
        return _compared(snapshot, camera, scene.near, count, view.rgb[frame[0]].to(scene.device) / 255)

    seen, wrong = (torch.zeros(count, device=scene.device) for _ in range(2))
    for visible, differs in each_on(scene.device, compared, frames.split(1)):
        seen += visible
        wrong += visible & differs
    kept = wrong <= MOST_WRONG * seen
    logger.info("%d of %d moving Gaussians contradicted by the video", count - int(kept.sum()), count)
    return scene.select_moving(kept)


def _compared(
    snapshot: Snapshot, camera: CameraTrack, near: float, count: int, recorded: Float[Tensor, "h w 3"]
) -> tuple[Bool[Tensor, " m"], Bool[Tensor, " m"]]:
    """Which of so many moving ones are to be seen at a frame, and which have another colour than the pixels there."""
    means, colours = snapshot.means[0, -count:], snapshot.rgb[0, -count:]
    seen = projected(means, camera)
    row, column = seen.pixel
    height, width = recorded.shape[:2]
    rendering = render_snapshot(snapshot, camera, near)
    away = (rendering.rgb[0].clamp(0, 1) - recorded).abs().mean(-1)
    away = torch.nn.functional.max_pool2d(away[None, None], 3, stride=1, padding=1)[0, 0]
    error = torch.full_like(means[:, 0], float("inf"))
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            pixel = recorded[(row + down).clamp(0, height - 1), (column + right).clamp(0, width - 1)]
            error = torch.minimum(error, (pixel - colours).abs().mean(-1))
    return seen.visible(rendering.depth[0]), (error > COLOUR_ERROR) & (away[row, column] > COLOUR_ERROR)
