"""Single frames of a saved scene from new cameras, as fast as training needs them."""

import threading
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, Int, UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.motion.model.bases import MotionLevel, level_affines
from lerobot_msdyn.render import rasterize
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.overlay import PATCH_OPACITY, FramePatch
from lerobot_msdyn.scene.store import SavedScene
from lerobot_msdyn.training.posing import pose
from lerobot_msdyn.views.coverage import HOLE_ALPHA
from lerobot_msdyn.views.filling import filled_softly


@dataclass(frozen=True)
class LivePictures:
    """Some frames of a new view."""

    rgb: UInt8[np.ndarray, "t 3 h w"]
    depth: Float32[np.ndarray, "t h w"]  # m, z-depth; 0 in holes, and everywhere without a true scale
    alpha: Float32[np.ndarray, "t h w"]  # 0..1: a hole below `HOLE_ALPHA`


class LiveScene:
    """A saved scene, prepared for rendering single frames; several threads take turns."""

    def __init__(self, scene: SavedScene) -> None:
        """Prepare every window."""
        self.scene = scene
        self._windows = [_LiveWindow(window) for window in scene.windows]
        self._turn = threading.Lock()  # whose thread writes to the buffers of the windows

    @property
    def size_in_bytes(self) -> int:
        """Memory of the scene and of what was prepared."""
        return self.scene.size_in_bytes + sum(window.size_in_bytes for window in self._windows)

    def render(self, camera: CameraTrack, frames: Int[Tensor, " t"]) -> LivePictures:
        """The scene at some frames through as many poses, holes filled."""
        height, width = camera.height, camera.width
        rgb = np.empty((len(frames), 3, height, width), np.uint8)
        depth = np.zeros((len(frames), height, width), np.float32)
        opacity = np.empty((len(frames), height, width), np.float32)
        windows = self.scene.windows_of(frames).tolist()
        for i, (number, frame) in enumerate(zip(windows, frames.tolist(), strict=True)):
            window, start = self._windows[number], self.scene.starts[number]
            with self._turn:
                colours, distance, alpha = window.render(camera.select([i]), frame - start)
            opaque = alpha >= HOLE_ALPHA
            opacity[i] = alpha
            rgb[i] = filled_softly(colours, opaque)
            if self.scene.metric:
                depth[i] = np.where(opaque, distance, np.float32(0))
        return LivePictures(rgb, depth, opacity)


class _LiveWindow:
    """One window's Gaussians in buffers whose static part is written once; behind them there is room for a patch."""

    def __init__(self, scene: DynamicScene) -> None:
        static, moving = scene.static, scene.moving
        self._scene, self._static, self._own = scene, len(static), len(static) + len(moving)
        self._static_rgb = static.rgb
        firsts = [part.first for part in (scene.short_lived, scene.overlay) if part is not None]
        room = sum(int(first.diff().max()) for first in firsts)
        self._scales = torch.cat((static.scales, moving.scales, torch.zeros(room, 3)))
        self._opacities = torch.cat((static.opacity_logits, moving.opacity_logits)).sigmoid()
        self._means = torch.cat((static.means, moving.means, torch.zeros(room, 3)))
        self._quats = torch.cat((static.quats, moving.quats, torch.zeros(room, 4)))
        self._rgb = torch.cat((static.rgb, moving.rgb, torch.zeros(room, 3)))
        self._shown = torch.cat((self._opacities, torch.full((room,), PATCH_OPACITY)))
        self._levels = [i for i, level in enumerate(scene.levels) if not _is_idle(level)]
        self._only_bases = all(isinstance(scene.levels[i], MotionLevel) for i in self._levels)
        if self._only_bases:
            self._prepare_bases()

    def _prepare_bases(self) -> None:
        """One table for the bases of all levels, at all frames."""
        scene, count = self._scene, len(self._scene.moving)
        times = torch.arange(scene.frames)
        levels = [scene.levels[i] for i in self._levels]
        maps = [level_affines(level, times).transpose(0, 1) for level in levels if isinstance(level, MotionLevel)]
        self._affines = torch.cat([torch.zeros(len(times), 0, 3, 4), *maps], dim=1).contiguous()
        firsts: np.ndarray = np.cumsum([0, *(part.shape[1] for part in maps)])
        indices = [scene.indices[i].numpy() + first for i, first in zip(self._levels, firsts[:-1], strict=True)]
        weights = [scene.logits[i].softmax(dim=-1).numpy() for i in self._levels]
        none = np.zeros((count, 0))
        self._indices = np.concatenate([none, *indices], axis=1).astype(np.int32)
        self._weights = np.concatenate([none, *weights], axis=1).astype(np.float32)
        self._bounds = np.cumsum([0] + [part.shape[1] for part in indices]).astype(np.int64)
        self._sh = np.ascontiguousarray(scene.moving.sh.numpy())

    @property
    def size_in_bytes(self) -> int:
        """Memory of the buffers."""
        shown = (self._static_rgb, self._scales, self._opacities, self._shown, self._means, self._quats, self._rgb)
        bases = (self._affines, self._indices, self._weights, self._sh) if self._only_bases else ()
        return sum(array.nbytes for array in (*shown, *bases))

    @torch.no_grad()
    def render(self, camera: CameraTrack, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colours uint8 [3,h,w], depth (m) [h,w] and opacity [h,w] of one frame through a camera of one pose."""
        time = torch.tensor([frame])
        eye = camera.world_from_camera[0, :3, 3]
        self._set_moving(time, eye)
        shading = self._scene.shading
        if shading is not None:
            torch.mul(self._static_rgb, shading.static_gain(time)[0, :, None], out=self._rgb[: self._static])
            self._rgb[self._static : self._own] *= shading.moving_gain(time)[0, :, None]
        count = self._put_patch(self._scene.patch(frame))
        raster = rasterize(
            self._means[:count],
            self._quats[:count],
            self._scales[:count],
            self._shown[:count],
            self._rgb[:count],
            camera.camera_from_world,
            camera.intrinsics,
            camera.width,
            camera.height,
            near=self._scene.near,
        )
        planes = raster.features[0].permute(2, 0, 1)  # as they lie in memory
        rgb = planes.clamp(0, 1).mul_(255).round_().to(torch.uint8)
        return rgb.numpy(), raster.depth[0].numpy(), raster.alpha[0].numpy()

    def _put_patch(self, patch: FramePatch | None) -> int:
        """Write a frame's patch behind the scene's own Gaussians, and hide those that it replaces; how many there are.

        What is hidden gets no opacity, which is faster than taking it out.
        """
        if patch is None:
            return self._own
        place = slice(self._own, self._own + len(patch))
        for buffer, values in ((self._means, patch.means), (self._quats, patch.quats), (self._rgb, patch.rgb)):
            buffer[place] = values
        torch.exp(patch.log_scales, out=self._scales[place])
        torch.mul(self._opacities, ~patch.hidden, out=self._shown[: self._own])
        return place.stop

    def _set_moving(self, time: Int[Tensor, " 1"], eye: Tensor) -> None:
        """Write positions, orientations and colours of the moving set at a time into the buffers."""
        moving = slice(self._static, self._own)
        if not self._only_bases:
            unlit = replace(self._scene, shading=None)
            snapshot = unlit.at(time, eye[None])
            for buffer, values in ((self._means, snapshot.means), (self._quats, snapshot.quats)):
                buffer[moving] = values[0, moving]
            self._rgb[moving] = snapshot.rgb[0, moving]
            return
        pose(
            self._scene.moving.means.numpy(),
            self._scene.moving.quats.numpy(),
            self._sh,
            self._affines[int(time)].numpy(),
            self._indices,
            self._weights,
            self._bounds,
            eye.numpy(),
            self._means[moving].numpy(),
            self._quats[moving].numpy(),
            self._rgb[moving].numpy(),
        )


def _is_idle(level: object) -> bool:
    """Whether a level moves nothing."""
    return isinstance(level, MotionLevel) and not bool(level.active.any())
