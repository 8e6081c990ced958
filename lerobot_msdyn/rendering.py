"""Pictures of a dynamic scene: frames from a camera track."""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.cameras import CameraTrack
from lerobot_msdyn.overlay import FramePatch
from lerobot_msdyn.render import Raster, rasterize
from lerobot_msdyn.scene import DynamicScene, Snapshot, patched


@dataclass(frozen=True)
class Rendering:
    """What a camera sees of a scene."""

    rgb: Float[Tensor, "t h w 3"]  # 0..1, over black
    depth: Float[Tensor, "t h w"]  # m, expected z-depth; 0 where nothing is
    alpha: Float[Tensor, "t h w"]  # 0..1
    moving: Float[Tensor, "t h w"]  # 0..1, share of the moving set and of overlays


def draw(scene: DynamicScene, camera: CameraTrack, frames: Tensor, backend: str = "auto") -> Rendering:
    """The scene at `frames` (int, [b]) through the b poses of `camera`; differentiable."""
    if scene.overlay is None:
        return _rasterized(scene.at(frames, camera.world_from_camera[:, :3, 3]), camera, backend)
    own = len(scene.static) + len(scene.moving)
    drawn = [
        draw_patched(scene, camera.select([i]), frame, scene.overlay.patch(frame, own), backend)
        for i, frame in enumerate(frames.tolist())
    ]
    return Rendering(*(torch.cat([getattr(one, item.name) for one in drawn]) for item in fields(Rendering)))


def draw_patched(
    scene: DynamicScene, camera: CameraTrack, frame: int, patch: FramePatch, backend: str = "auto"
) -> Rendering:
    """The scene at one frame through one pose, with a patch in place of what the patch hides."""
    snapshot = scene.at(torch.tensor([frame]), camera.world_from_camera[:, :3, 3])
    return _rasterized(patched(snapshot, patch), camera, backend)


def _rasterized(snapshot: Snapshot, camera: CameraTrack, backend: str) -> Rendering:
    moving = snapshot.moving[:, None].expand(len(camera), -1, 1)
    raster: Raster = rasterize(
        snapshot.means,
        snapshot.quats,
        snapshot.scales,
        snapshot.opacities,
        torch.cat((snapshot.rgb, moving), dim=-1),
        camera.camera_from_world,
        camera.intrinsics,
        camera.width,
        camera.height,
        backend=backend,
    )
    return Rendering(raster.features[..., :3], raster.depth, raster.alpha, raster.features[..., 3])


@torch.no_grad()
def render_frames(
    scene: DynamicScene, camera: CameraTrack, frames: Tensor | None = None, *, batch: int = 8, backend: str = "auto"
) -> Iterator[Rendering]:
    """The whole scene in batches of frames, so that memory stays bounded; `frames` (int, [t]) defaults to all."""
    frames = torch.arange(scene.frames) if frames is None else frames
    for start in range(0, len(frames), batch):
        part = slice(start, min(start + batch, len(frames)))
        yield draw(scene, camera.select(part), frames[part], backend)
