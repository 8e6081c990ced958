"""Pictures of a dynamic scene: frames from a camera track."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.render import Raster, rasterize
from lerobot_msdyn.render.cpu.threads import torch_on_one_thread
from lerobot_msdyn.scene.dynamic import DynamicScene, Snapshot, patched, patched_together
from lerobot_msdyn.scene.overlay import FramePatch
from lerobot_msdyn.scene.still_view import StillView

_FAINT = 1e-6  # opacity by which nothing is divided


@dataclass(frozen=True)
class Rendering:
    """What a camera sees of a scene."""

    rgb: Float[Tensor, "t h w 3"]  # 0..1, over black
    depth: Float[Tensor, "t h w"]  # m, expected z-depth; 0 where nothing is
    alpha: Float[Tensor, "t h w"]  # 0..1
    moving: Float[Tensor, "t h w"]  # 0..1, share of the moving set and of patches
    extra: Float[Tensor, "t h w"] | None = None  # values of the moving Gaussians, blended like colours


def render_scene(
    scene: DynamicScene,
    camera: CameraTrack,
    frames: Tensor,
    backend: str = "auto",
    extra: Float[Tensor, " m"] | None = None,
    still: StillView | None = None,
) -> Rendering:
    """The scene at `frames` (int, [b]) through the b poses of `camera`; differentiable.

    `extra` is a value per moving Gaussian to be rendered as well; patches have one of 1. `still` is the scene's static
    set before this camera, where it keeps still. Runs on the scene's device; frames and camera may be on the host.
    """
    if scene.overlay is None and scene.short_lived is None:
        camera, frames = to_device((camera, frames), scene.device)
        return render_snapshot(_snapshot(scene, camera, frames, extra, still), camera, scene.near, backend)
    patches = [patch for frame in frames.tolist() if (patch := scene.patch(frame)) is not None]
    if scene.device.type != "cpu":
        return render_patched_together(scene, camera, frames, patches, backend, extra)
    parts = [
        render_patched(scene, camera.select([i]), frame, patch, backend, extra, still)
        for i, (frame, patch) in enumerate(zip(frames.tolist(), patches, strict=True))
    ]
    if len(parts) == 1:
        return parts[0]
    names = [item.name for item in fields(Rendering) if getattr(parts[0], item.name) is not None]
    return Rendering(**{name: torch.cat([getattr(one, name) for one in parts]) for name in names})


def render_patched(
    scene: DynamicScene,
    camera: CameraTrack,
    frame: int,
    patch: FramePatch,
    backend: str = "auto",
    extra: Float[Tensor, " m"] | None = None,
    still: StillView | None = None,
) -> Rendering:
    """The scene at one frame through one pose, with a patch in place of what the patch hides."""
    camera, when, patch = to_device((camera, torch.tensor([frame]), patch), scene.device)
    return render_snapshot(patched(_snapshot(scene, camera, when, extra, still), patch), camera, scene.near, backend)


def render_patched_together(
    scene: DynamicScene,
    camera: CameraTrack,
    frames: Tensor,
    patches: Sequence[FramePatch],
    backend: str = "auto",
    extra: Float[Tensor, " m"] | None = None,
) -> Rendering:
    """As `render_patched`, some frames at once, each through its pose and with its patch."""
    camera, when = to_device((camera, frames), scene.device)
    snapshot = patched_together(_snapshot(scene, camera, when, extra), patches)
    return render_snapshot(snapshot, camera, scene.near, backend)


def _snapshot(
    scene: DynamicScene,
    camera: CameraTrack,
    frames: Tensor,
    extra: Float[Tensor, " m"] | None,
    still: StillView | None = None,
) -> Snapshot:
    backdrop = None if still is None else still.at(frames)
    snapshot = scene.at(frames, camera.world_from_camera[:, :3, 3], backdrop)
    if extra is None:
        return snapshot
    none = extra.new_zeros(len(scene.static) if backdrop is None else 0)
    return replace(snapshot, extra=torch.cat((none, extra)))


def render_snapshot(snapshot: Snapshot, camera: CameraTrack, near: float, backend: str = "auto") -> Rendering:
    """What one pose per frame of a snapshot sees of it; all on one device."""
    values = [snapshot.moving] if snapshot.extra is None else [snapshot.moving, snapshot.extra]
    backdrop = snapshot.backdrop
    if backdrop is not None:
        backdrop = replace(backdrop, plain=torch.nn.functional.pad(backdrop.plain, (0, len(values))))
    raster: Raster = rasterize(
        snapshot.means,
        snapshot.quats,
        snapshot.scales,
        snapshot.opacities,
        torch.cat((snapshot.rgb, torch.stack(values, dim=-1).expand(len(camera), -1, -1)), dim=-1),
        camera.camera_from_world,
        camera.intrinsics,
        camera.width,
        camera.height,
        near=near,
        backend=backend,
        backdrop=backdrop,
    )
    rgb, moving, *more = raster.features.split([3] + [1] * len(values), dim=-1)
    return Rendering(rgb, raster.depth, raster.alpha, moving[..., 0], more[0][..., 0] if more else None)


def render_positions(
    scene: DynamicScene, camera: CameraTrack, frame: int, times: Int[Tensor, " b"], backend: str = "auto"
) -> tuple[Float[Tensor, "h w b 3"], Float[Tensor, "h w"]]:
    """Where what is seen at one frame, through one pose, is at some times (m, in the world); and its opacity.

    Positions are blended like colours and divided by the opacity (Shape of Motion, Wang et al. 2024, section 3.3).
    Differentiable; the scene's patches are left out.
    """
    camera, when = to_device((camera, torch.tensor([frame])), scene.device)
    snapshot = scene.at(when)
    positions = scene.positions(times).transpose(0, 1)
    raster = rasterize(
        snapshot.means,
        snapshot.quats,
        snapshot.scales,
        snapshot.opacities,
        positions.flatten(1),
        camera.camera_from_world,
        camera.intrinsics,
        camera.width,
        camera.height,
        near=scene.near,
        backend=backend,
    )
    blended = raster.features[0] / raster.alpha[0, ..., None].clamp(min=_FAINT)
    return blended.unflatten(-1, (len(times), 3)), raster.alpha[0]


@torch.no_grad()
def render_frames(
    scene: DynamicScene,
    camera: CameraTrack,
    frames: Tensor | None = None,
    *,
    batch: int = 8,
    backend: str = "auto",
    extra: Float[Tensor, " m"] | None = None,
    still: StillView | None = None,
) -> Iterator[Rendering]:
    """The whole scene in batches of frames, so that memory stays bounded; `frames` (int, [t]) defaults to all."""
    frames = torch.arange(scene.frames) if frames is None else frames
    for start in range(0, len(frames), batch):
        part = slice(start, min(start + batch, len(frames)))
        with torch_on_one_thread():
            rendered = render_scene(scene, camera.select(part), frames[part], backend, extra, still)
        yield rendered
