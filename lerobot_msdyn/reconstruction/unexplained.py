"""Where the recorded camera shows something else than the scene does, and what it shows there, as Gaussians."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.sampling import scaled_px
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.core.visibility import Projection, projected
from lerobot_msdyn.priors import Priors
from lerobot_msdyn.reconstruction.background import fill_depth, pixel_gaussians
from lerobot_msdyn.scene.dynamic import DynamicScene, Snapshot, patched
from lerobot_msdyn.scene.footprints import Footprints, footprints
from lerobot_msdyn.scene.overlay import FramePatch
from lerobot_msdyn.scene.rendering import Rendering, render_scene, render_snapshot
from lerobot_msdyn.scene.still_view import StillView

COLOUR_ERROR = 0.06  # mean absolute difference of colours 0..1, over about a pixel, beyond which one is not explained
DEPTH_ERROR = 0.02  # relative difference of depths beyond which it is not, at least
NEVER = 1e6  # a relative difference of depths that there is not
JUMP = 0.05  # relative step of depth to the surface in front, beyond which a pixel belongs to the one behind
THICKNESS = 0.03  # share of the depth within which a Gaussian belongs to the recorded surface
SCALE = 0.7  # of a pixel's Gaussian: its neighbours are rendered as well
ERROR_AROUND = 0.04  # the same over several pixels of the moving set, all of which it then condemns
SMOOTH_PX, _AROUND_PX = 1.0, 8.0  # standard deviations of these averages, at a width of 320
_BESIDE = np.ones((3, 3), np.uint8)  # a pixel and those beside it


@dataclass(frozen=True)
class _Static:
    """The static set of a scene (on any device) before one pose of the recorded camera."""

    scene: DynamicScene
    camera: CameraTrack  # of one pose, on the device of the scene
    backend: str
    once: bool  # whether one picture sees it from there, or many

    @cached_property
    def view(self) -> StillView:
        """For pictures."""
        return self.scene.still_view(self.camera, self.backend, once=self.once)

    @cached_property
    def seen(self) -> Projection:
        """Where its centres are seen; on the host."""
        return projected(*to_device((self.scene.static.means, self.camera), "cpu"))

    @cached_property
    def prints(self) -> Footprints:
        """What its Gaussians may cover."""
        return footprints(self.scene.static.means, self.scene.static.scales.amax(-1), self.camera)

    @cached_property
    def depth(self) -> Float[ndarray, "h w"]:
        """Of what stands still (m)."""
        frame, alone = torch.tensor([0]), self.scene.still()
        return render_scene(alone, self.camera, frame, self.backend, still=self.view).depth[0].cpu().numpy()


@dataclass(frozen=True)
class Comparison:
    """A fitted scene, on any device, against its video at the size at which it was fitted."""

    scene: DynamicScene  # without an overlay
    view: View
    priors: Priors
    backend: str = "auto"  # of the rasterizer

    @cached_property
    def tolerance(self) -> float:
        """Relative difference of depths beyond which a picture is wrong; beyond all for depth that is only assumed."""
        traits = self.priors.depth_traits
        return NEVER if traits.assumed else max(DEPTH_ERROR, traits.relative_error)

    def depth(self, frame: int) -> Float[Tensor, "h w"]:
        """What the video is taken to show (m), without gaps."""
        return fill_depth(self.priors.depth[frame])

    def snapshot(self, frame: int) -> Snapshot:
        """The moving set of the scene as the recorded camera sees it, before the static one."""
        camera, when = self._pose(frame), to_device(torch.tensor([frame]), self.scene.device)
        return self.scene.at(when, camera.world_from_camera[:, :3, 3], self._static(frame).view.at(when))

    def wrong(self, snapshot: Snapshot, frame: int) -> Bool[ndarray, "h w"]:
        """Where the picture of a snapshot has another colour or depth than the recorded one."""
        rendering = to_device(render_snapshot(snapshot, self._pose(frame), self.scene.near, self.backend), "cpu")
        recorded = self.view.rgb[frame].float() / 255
        return wrong_pixels(rendering, recorded, self.depth(frame).numpy(), self.tolerance)

    def taken(self, wrong: Bool[ndarray, "h w"], frame: int) -> Bool[ndarray, "h w"]:
        """Those of the wrong pixels whose recorded colour is that of one surface."""
        return wrong & ~_behind_an_edge(self.depth(frame).numpy(), self._static(frame).depth)

    def patch(
        self, snapshot: Snapshot, frame: int, wrong: Bool[ndarray, "h w"], taken: Bool[ndarray, "h w"]
    ) -> FramePatch:
        """The pixels that are taken as Gaussians, with colours that make the rendered picture the recorded one.

        What a pixel's Gaussian lacks of the recorded colour is added to its own, by no more than the contrast to the
        pixels beside, which are what mixes with it. More is lacking where something else is seen through, as at the
        picture's border: from another camera, that would be a bright line.
        """
        picture, depth, chosen = self.view.rgb[frame], self.depth(frame), torch.from_numpy(taken)
        pixels = pixel_gaussians(picture, depth, self.view.camera, frame, where=chosen)[0]
        hidden = self.hidden(snapshot.means[0], frame, torch.from_numpy(wrong), chosen)
        log_scales, recorded = pixels.log_scales + math.log(SCALE), picture[chosen].float() / 255
        first = FramePatch(pixels.means, pixels.quats, log_scales, recorded, hidden)
        if len(first) == 0:
            return first
        camera = self._pose(frame)
        prints = self._static(frame).prints, footprints(snapshot.means[0], snapshot.scales.amax(-1), camera)
        beside = torch.cat([each.may_cover(taken) for each in prints])  # all that these pixels show
        alone = to_device(replace(first, hidden=hidden | ~beside.cpu()), snapshot.means.device)
        shown = patched(snapshot, alone)
        rendered = render_snapshot(shown, camera, self.scene.near, self.backend).rgb[0].cpu()[chosen]
        most = _contrast(picture)[chosen]
        lacking = (recorded - rendered).clamp(-most, most)
        return replace(first, rgb=(recorded + lacking).clamp(0, 1.5))

    def hidden(
        self, moving: Float[Tensor, "m 3"], frame: int, wrong: Bool[Tensor, "h w"], taken: Bool[Tensor, "h w"]
    ) -> Bool[Tensor, " g"]:
        """Gaussians on or before the recorded surface: moving ones where it is wrong, static ones where it is replaced.

        The static ones come first; the moving ones are at some places (m).
        """
        depth, still = self.depth(frame), self._static(frame).seen
        seen = projected(moving.cpu(), self.view.camera.select([frame]))
        where = taken[still.pixel], wrong[seen.pixel]
        return torch.cat((where[0] & still.visible(depth, THICKNESS), where[1] & seen.visible(depth, THICKNESS)))

    def _pose(self, frame: int) -> CameraTrack:
        return to_device(self.view.camera.select([frame]), self.scene.device)

    def _static(self, frame: int) -> _Static:
        if self.view.camera.is_static:
            return self._fixed
        return _Static(self.scene, self._pose(frame), self.backend, once=True)

    @cached_property
    def _fixed(self) -> _Static:
        """What a fixed camera sees of it, worked out once."""
        return _Static(self.scene, self._pose(0), self.backend, once=False)


def wrong_pixels(
    rendering: Rendering, recorded: Float[Tensor, "h w 3"], depth: Float[ndarray, "h w"], tolerance: float
) -> Bool[ndarray, "h w"]:
    """Where a rendered picture has another colour or depth (m) than the recorded one, and the pixels beside."""
    difference = (rendering.rgb[0].clamp(0, 1) - recorded).abs().mean(-1).numpy()
    rendered = rendering.depth[0].numpy()
    moving = (rendering.moving[0] > 0.5).numpy()
    smooth_px, around_px = (scaled_px(px, depth.shape[1]) for px in (SMOOTH_PX, _AROUND_PX))
    around = blurred(difference * moving, around_px) > ERROR_AROUND * blurred(moving, around_px)
    wrong = (blurred(difference, smooth_px) > COLOUR_ERROR) | (np.abs(rendered / depth - 1) > tolerance)
    wrong |= moving & around
    # Behind an edge colours are mixed, and say nothing; there only the depth of no pixel beside counts as wrong.
    nearest, farthest = (1 - tolerance) * cv2.erode(rendered, _BESIDE), (1 + tolerance) * cv2.dilate(rendered, _BESIDE)
    wrong = np.where(_behind(depth), (depth < nearest) | (depth > farthest), wrong)
    opened = cv2.morphologyEx(wrong.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    return cv2.dilate(opened, _BESIDE) > 0


def blurred(image: Float[ndarray, "h w"] | Bool[ndarray, "h w"], sigma_px: float) -> Float[ndarray, "h w"]:
    """Averaged by a Gaussian of a standard deviation in pixels."""
    return cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma_px)


def _behind(depth: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Pixels beside a nearer surface."""
    return depth > (1 + JUMP) * cv2.erode(depth, _BESIDE)


def _behind_an_edge(depth: Float[ndarray, "h w"], still: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Pixels beside a nearer surface, whose colours mix with its own, that float or that the static set shows."""
    behind = _behind(depth)
    floating = behind & ((1 + JUMP) * depth < cv2.dilate(depth, _BESIDE))
    return floating | (behind & (np.abs(still / depth - 1) < DEPTH_ERROR))


def _contrast(rgb: UInt8[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """The range of each colour over a pixel and those beside, 0..1."""
    picture = rgb.numpy()
    return torch.from_numpy(cv2.dilate(picture, _BESIDE) - cv2.erode(picture, _BESIDE)).float() / 255
