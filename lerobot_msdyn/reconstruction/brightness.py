"""How brightness changes over time: of the static set by the video alone, of the moving set by a rendered scene."""

import contextlib
import functools
from collections import deque
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import invert_se3, nearest_pixel, transform_points, unproject_image
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.sampling import scaled_px, scaled_window
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.core.visibility import projected
from lerobot_msdyn.priors import Priors
from lerobot_msdyn.render.cpu.threads import each_on, in_threads
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.rendering import render_scene
from lerobot_msdyn.scene.shading import Shading, encode_gain, no_shading
from lerobot_msdyn.scene.still_view import StillView

BLUR_PX = 1.5  # of 320: noise, and texture that does not fit, are averaged over about this
FIELD_STEP = 2  # px of the fitted image per pixel of the field of gains
MASK_MARGIN_PX = 2  # of 320: colours of what moves bleed this far
FLOOR = 4.0  # grey levels added to both sides of a ratio: noise in the dark is no gain
SURE_WEIGHT = 0.5  # share of the blur's window that must be known
MOVING_STEP = 2  # the moving set is measured at every second frame, and over three of these


def static_shading(scene: DynamicScene, view: View, priors: Priors, empty: UInt8[Tensor, "h w 3"]) -> Shading:
    """Shading of the static set of a scene on the host; that of the moving set is one.

    The gain of a pixel is the ratio of the frame to what stands still there, both without what moves, blurred over
    pixels and averaged over three frames. Behind what moves it is that of its surroundings.

    Args:
        scene: before the fit.
        view: the video.
        priors: what moves in it.
        empty: what a fixed camera sees where nothing moves; before one that moves, the static set is rendered.
    """
    frames = len(view.rgb)
    if view.camera.is_static:
        still = _grey(empty.numpy())
        camera = view.camera.select([0])
        places = projected(scene.static.means, camera).xy / torch.tensor([camera.width, camera.height]) * 2 - 1

        def sums_of(frame: int) -> Float32[ndarray, "a b 3"]:
            return _field_sums(view, priors, still, frame)
    else:
        around = _Directions.of(scene.static.means, view.camera)
        places = around.places(scene.static.means)

        def sums_of(frame: int) -> Float32[ndarray, "a b 3"]:
            return _rendered_sums(scene, view, priors, frame, around)

    fields = []
    with contextlib.closing(in_threads(sums_of, range(frames))) as coming:
        sums = deque(islice(coming, 2), maxlen=3)  # of a frame and those beside it
        for t in range(frames):
            fields.append(encode_gain(torch.from_numpy(_ratio(np.sum(sums, axis=0)))))
            if t + 2 < frames:
                sums.append(next(coming))
            elif t > 0:
                sums.popleft()
    return Shading(torch.stack(fields), places, no_shading(0, len(scene.moving), frames).moving)


def _field_sums(view: View, priors: Priors, empty: Float32[ndarray, "h w"], frame: int) -> Float32[ndarray, "a b 3"]:
    """Blurred brightness of the frame and of the empty scene where nothing moves, and the share of such pixels."""
    window = scaled_window(MASK_MARGIN_PX, view.camera.width)
    still = cv2.dilate((priors.instances[frame] > 0).numpy().astype(np.uint8), window) == 0
    height, width = still.shape
    sums = _blurred_sums(_grey(view.rgb[frame].numpy()), empty, still)
    size = (-(-width // FIELD_STEP), -(-height // FIELD_STEP))
    return cv2.resize(sums, size, interpolation=cv2.INTER_AREA)


@dataclass(frozen=True)
class _Directions:
    """A picture of all directions in which a moving camera sees the static set from its usual place.

    What it maps does not move when the camera does.
    """

    camera_from_world: Float[Tensor, "4 4"]  # of the usual place
    low: Float[Tensor, "2"]  # rad, the smallest azimuth and elevation ...
    high: Float[Tensor, "2"]  # ... and the largest
    width: int
    height: int

    @classmethod
    def of(cls, means: Float[Tensor, "g 3"], camera: CameraTrack) -> "_Directions":
        """With pixels of about the size of a fixed camera's field of gains."""
        pose = camera.world_from_camera[len(camera) // 2].clone()
        pose[:3, 3] = camera.world_from_camera[:, :3, 3].median(0).values
        from_world = invert_se3(pose)
        angles = _angles(transform_points(from_world, means))
        low, high = angles.amin(0), angles.amax(0)
        width, height = ((high - low) * float(camera.intrinsics[0, 0, 0]) / FIELD_STEP).ceil().clamp(1, 2048).tolist()
        return cls(from_world, low, high, int(width), int(height))

    def places(self, points: Float[Tensor, "g 3"]) -> Float[Tensor, "g 2"]:
        """Where points (m, world) are in the picture, -1..1."""
        angles = _angles(transform_points(self.camera_from_world, points))
        return (angles - self.low) / (self.high - self.low).clamp(min=1e-6) * 2 - 1

    def gathered(
        self, points: Float[Tensor, "g 3"], values: Float32[ndarray, "g c"]
    ) -> Float32[ndarray, "{self.height} {self.width} c"]:
        """The sums of some values of points in each pixel."""
        shares = (self.places(points) + 1) / 2 * torch.tensor([self.width, self.height])
        row, column = nearest_pixel(shares, self.width, self.height)
        out = np.zeros((self.height * self.width, values.shape[1]), np.float32)
        np.add.at(out, (row * self.width + column).numpy(), values)
        return out.reshape(self.height, self.width, -1)


def _angles(points: Float[Tensor, "g 3"]) -> Float[Tensor, "g 2"]:
    """Azimuth and elevation (rad) of points in a camera's axes."""
    x, y, z = points.unbind(-1)
    return torch.stack((torch.atan2(x, z), torch.atan2(y, torch.hypot(x, z))), dim=-1)


@torch.no_grad()
def _rendered_sums(
    scene: DynamicScene, view: View, priors: Priors, frame: int, around: _Directions
) -> Float32[ndarray, "a b 3"]:
    """As `_field_sums`, of the static set as it is rendered, in the picture of all directions."""
    camera = view.camera.select([frame])
    rendered = render_scene(scene.still(), camera, torch.tensor([frame]))
    window = scaled_window(MASK_MARGIN_PX, view.camera.width)
    still = cv2.dilate((priors.instances[frame] > 0).numpy().astype(np.uint8), window) == 0
    still &= (rendered.alpha[0] > SURE_WEIGHT).numpy()
    sums = _blurred_sums(_grey(view.rgb[frame].numpy()), _grey(255 * rendered.rgb[0].numpy()), still)
    offset = FIELD_STEP // 2
    take = (slice(offset, None, FIELD_STEP), slice(offset, None, FIELD_STEP))
    points = unproject_image(rendered.depth[0], camera.intrinsics[0])[take].reshape(-1, 3)
    known = (rendered.depth[0][take] > 0).reshape(-1)
    in_world = transform_points(camera.world_from_camera[0], points[known])
    return around.gathered(in_world, sums[take].reshape(-1, 3)[known.numpy()])


def _blurred_sums(
    numerator: Float32[ndarray, "h w"], denominator: Float32[ndarray, "h w"], usable: Bool[ndarray, "h w"]
) -> Float32[ndarray, "h w 3"]:
    weight = usable.astype(np.float32)
    stacked = np.stack(((numerator + FLOOR) * weight, (denominator + FLOOR) * weight, weight), axis=-1)
    return cv2.GaussianBlur(stacked, (0, 0), scaled_px(BLUR_PX, usable.shape[1]))


def _ratio(sums: Float32[ndarray, "a b 3"]) -> Float32[ndarray, "a b"]:
    """Ratio of the first two sums; where the third, their weight, is small, that of ever larger surroundings."""
    pyramid = [sums]
    while min(pyramid[-1].shape[:2]) > 2:
        height, width = pyramid[-1].shape[:2]
        pyramid.append(cv2.resize(pyramid[-1], (-(-width // 2), -(-height // 2)), interpolation=cv2.INTER_AREA))
    log = np.zeros(pyramid[-1].shape[:2], np.float32)
    for level in reversed(pyramid):
        log = cv2.resize(log, level.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        certainty = np.clip(level[..., 2] / SURE_WEIGHT, 0, 1)
        ratio = np.log((level[..., 0] + 1e-6) / (level[..., 1] + 1e-6))
        log += certainty * (ratio - log)
    return np.exp(log)


def _grey(rgb: UInt8[ndarray, "h w 3"] | Float32[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    return rgb.astype(np.float32).mean(-1)


@torch.no_grad()
def moving_gain(scene: DynamicScene, view: View, priors: Priors, backend: str = "auto") -> UInt8[Tensor, "t m"]:
    """Coded gains by which every moving Gaussian differs from its colour over time, on the host.

    At every second frame, each Gaussian that is seen is compared at its pixel: the ratio of the recorded to the
    rendered picture, of moving surfaces only, blurred over pixels, averaged over time, and interpolated where unseen.
    Rendered with the gains that the scene has already, so that these only need to be multiplied by what is returned.
    """
    frames = sorted({*range(0, len(view.rgb), MOVING_STEP), len(view.rgb) - 1})
    still = scene.still_before(view.camera, backend)
    of_frame = functools.partial(_seen_sums, scene, view, priors, backend, still)
    sums = torch.stack([*each_on(scene.device, of_frame, frames)])  # s m 2
    if len(frames) > 2:
        padded = torch.nn.functional.pad(sums.permute(1, 2, 0), (1, 1))
        sums = torch.nn.functional.avg_pool1d(padded, 3, stride=1).permute(2, 0, 1)
    seen = sums[..., 1] > 0
    log = torch.where(seen, (sums[..., 0] / sums[..., 1].clamp(min=1e-6)).clamp(min=1e-6).log(), 0.0)
    return encode_gain(_at_every_frame(log, seen, torch.tensor(frames), len(view.rgb)).exp())


def _seen_sums(
    scene: DynamicScene, view: View, priors: Priors, backend: str, still: StillView | None, frame: int
) -> Float[Tensor, "m 2"]:
    """Blurred brightness recorded and rendered at the pixel of each moving Gaussian; zero where it is not seen."""
    camera, when = view.camera.select([frame]), torch.tensor([frame])
    rendered = to_device(render_scene(scene, camera, when, backend, still=still), "cpu")
    usable = ((rendered.moving[0] > SURE_WEIGHT) & (priors.instances[frame] > 0)).numpy()
    recorded, rendered_grey = _grey(view.rgb[frame].numpy()), _grey(255 * rendered.rgb[0].numpy())
    sums = torch.from_numpy(_blurred_sums(recorded, rendered_grey, usable))
    means = scene.positions(when)[0, len(scene.static) :].cpu()
    seen = projected(means, camera)
    own = sums[seen.pixel]
    compared = seen.visible(rendered.depth[0]) & (own[:, 2] > SURE_WEIGHT)
    return own[:, :2] * compared[:, None]


def _at_every_frame(
    values: Float[Tensor, "s m"], known: Bool[Tensor, "s m"], times: Tensor, frames: int
) -> Float[Tensor, "{frames} m"]:
    """Values at some times, linearly interpolated between the nearest known ones, held outside, zero where unknown."""
    index = torch.arange(len(values))[:, None].expand_as(known)
    before = torch.where(known, index, -1).cummax(0).values
    after = torch.where(known, index, len(values)).flip(0).cummin(0).values.flip(0)
    nearest = torch.where(before >= 0, before, after).clamp(max=len(values) - 1)
    before, after = nearest, torch.where(after < len(values), after, nearest)
    out = torch.empty(frames, values.shape[1])
    for frame in range(frames):
        right = int(torch.searchsorted(times, torch.tensor(frame)))
        left = right if int(times[right]) == frame else right - 1
        start, end = before[left], after[right]
        span = (times[end] - times[start]).clamp(min=1)
        between = ((frame - times[start]) / span).clamp(0, 1)
        out[frame] = torch.lerp(values.gather(0, start[None])[0], values.gather(0, end[None])[0], between)
    return out
