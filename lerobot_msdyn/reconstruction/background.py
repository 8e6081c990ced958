"""The static set of a fixed camera: one flat Gaussian per pixel of the empty scene, as far as it was ever seen."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import matrix_to_quaternion, pixel_grid, transform_points, unproject_image
from lerobot_msdyn.core.images import masked_median, nearest_of
from lerobot_msdyn.core.sampling import evenly, scaled_px
from lerobot_msdyn.scene.gaussians import Gaussians, gaussians_from_points

SIGMA_PX = 0.5  # standard deviation of a Gaussian, as a share of the spacing of its grid
FLATNESS = 0.2  # thickness along the surface normal, as a share of the width
MAX_STRETCH = 4.0  # surfaces seen at a grazing angle are stretched at most so much
OPACITY = 0.95
SAMPLES = 60  # frames over which medians are taken where they suffice ...
FEW = 10  # ... which is where so many of them show the empty scene; elsewhere all frames are looked at
MARGIN_PX = 2  # of 320: what moves bleeds so far beyond its mask: blur, the codec, and the mask's own error
INPAINT_RADIUS_PX, LEAST_RADIUS_PX = 3, 2  # the first of 320
NEAR = 0.01  # of the look-at distance, within which nothing is rendered: depth may be of any scale


@dataclass(frozen=True)
class EmptyScene:
    """What a fixed camera sees where nothing moves."""

    rgb: UInt8[Tensor, "h w 3"]  # where never seen, continued from the surroundings
    depth: Float[Tensor, "h w"]  # m, 0 = unknown
    seen: Int[Tensor, "h w"]  # frames that show it; at most those that were looked at


def empty_scene(
    rgb: UInt8[Tensor, "t h w 3"], depth: Float[Tensor, "t h w"], instances: UInt8[Tensor, "t h w"]
) -> EmptyScene:
    """Median colour and depth of every pixel over frames in which nothing moves there, nor close by if there are such.

    Args:
        rgb: the video.
        depth: its z-depth (m, 0 = unknown).
        instances: what moves, 0 = nothing.
    """
    frames, height, width = instances.shape
    colours, depths = rgb.numpy().reshape(frames, -1, 3), depth.numpy().reshape(frames, -1)
    median = np.zeros((height * width, 4), np.float32)
    seen = np.zeros(height * width, np.int64)
    widest = max(1, round(scaled_px(MARGIN_PX, width)))
    for margin in range(widest, -1, -1):  # closer to what moves only where nothing better shows a pixel
        window = np.ones((2 * margin + 1,) * 2, np.uint8)
        still = np.stack([cv2.dilate((mask > 0).astype(np.uint8), window) == 0 for mask in instances.numpy()])
        still = still.reshape(frames, -1)
        sample = evenly(frames, SAMPLES).numpy()
        some = np.flatnonzero(seen == 0)
        median[some], seen[some] = _median_of(colours, depths, still, some, sample)
        rare = some[seen[some] < min(FEW, len(sample))]
        median[rare], seen[rare] = _median_of(colours, depths, still, rare, np.arange(frames))
    unknown = (seen == 0).reshape(height, width)
    picture = median[:, :3].round().astype(np.uint8).reshape(height, width, 3)
    if unknown.any() and not unknown.all():
        radius_px = max(LEAST_RADIUS_PX, scaled_px(INPAINT_RADIUS_PX, width))
        picture = cv2.inpaint(picture, unknown.astype(np.uint8), radius_px, cv2.INPAINT_TELEA)
    return EmptyScene(
        torch.from_numpy(picture),
        torch.from_numpy(median[:, 3].reshape(height, width)),
        torch.from_numpy(seen.reshape(height, width)),
    )


def _median_of(
    colours: UInt8[ndarray, "t p 3"],
    depths: Float[ndarray, "t p"],
    still: Bool[ndarray, "t p"],
    pixels: Int[ndarray, " q"],
    frames: Int[ndarray, " s"],
) -> tuple[Float32[ndarray, "q 4"], Int[ndarray, " q"]]:
    """Median colour and depth of some pixels over those of some frames in which they are still; how many these are."""
    rows = np.ix_(frames, pixels)
    values = np.concatenate((colours[rows], depths[rows][..., None]), axis=-1, dtype=np.float32)
    usable = np.repeat(still[rows][..., None], values.shape[-1], axis=-1)
    usable[..., -1] &= values[..., -1] > 0  # a depth of 0 is unknown
    return masked_median(values, usable), still[rows].sum(0)


def fill_depth(depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Depth (m, 0 = unknown) with each unknown pixel taken from the nearest known one; all unknown: 1 m."""
    known = (depth > 0).numpy()
    if known.all():
        return depth
    if not known.any():
        return torch.ones_like(depth)
    return torch.from_numpy(depth.numpy().ravel()[nearest_of(known)])


def surface_frames(
    points: Float[Tensor, "*n 3"], dx: Float[Tensor, "*n 3"], dy: Float[Tensor, "*n 3"]
) -> tuple[Float[Tensor, "*n 3 3"], Float[Tensor, "*n"]]:
    """Rotations whose third column is the surface normal (towards the camera), and the cosine of the viewing angle.

    Args:
        points: of a surface, in the camera's axes.
        dx: how they change from pixel to pixel to the right.
        dy: and downwards.
    """
    normal = torch.nn.functional.normalize(torch.linalg.cross(dy, dx), dim=-1)
    view = torch.nn.functional.normalize(points, dim=-1)
    cosine = -(normal * view).sum(-1)
    # At depth edges the normal means nothing: there the disc faces the camera.
    doubtful = (cosine < 1 / MAX_STRETCH)[..., None]
    normal = torch.where(doubtful, -view, normal)
    # First column: the direction in which the surface recedes, along which a pixel's footprint is stretched.
    tilt = -view - (-view * normal).sum(-1, keepdim=True) * normal
    helper = torch.tensor([1.0, 0.0, 0.0]).expand_as(normal)
    sideways = torch.linalg.cross(normal, helper)
    first = torch.where(tilt.norm(dim=-1, keepdim=True) > 1e-3, tilt, sideways)
    first = torch.nn.functional.normalize(first, dim=-1)
    rotation = torch.stack((first, torch.linalg.cross(normal, first), normal), dim=-1)
    return rotation, torch.where(doubtful[..., 0], torch.ones_like(cosine), cosine)


def pixel_gaussians(
    rgb: UInt8[Tensor, "h w 3"],
    depth: Float[Tensor, "h w"],
    camera: CameraTrack,
    frame: int,
    step: int = 1,
    where: Bool[Tensor, "h w"] | None = None,
) -> tuple[Gaussians, Float[Tensor, "n 2"]]:
    """One flat Gaussian for every `step`-th pixel of an image with dense depth (m), and the pixels' centres (px).

    `where`: of these pixels alone.
    """
    intrinsics = camera.intrinsics[frame]
    image = unproject_image(depth, intrinsics)
    offset = step // 2
    every = torch.zeros(depth.shape, dtype=torch.bool)
    every[offset::step, offset::step] = True
    take = every if where is None else every & where
    dy, dx = torch.gradient(image, dim=(0, 1))
    points = image[take]
    rotation, cosine = surface_frames(points, dx[take], dy[take])
    width = SIGMA_PX * step * points[:, 2] / intrinsics[0, 0]
    scales = torch.stack((width / cosine.clamp(min=1 / MAX_STRETCH), width, width * FLATNESS), dim=-1)
    world_from_camera = camera.world_from_camera[frame]
    gaussians = gaussians_from_points(
        means=transform_points(world_from_camera, points),
        quats=matrix_to_quaternion(world_from_camera[:3, :3] @ rotation),
        scales=scales,
        rgb=rgb[take].float() / 255,
        opacity=OPACITY,
    )
    return gaussians, pixel_grid(*depth.shape)[take]


def background_gaussians(
    median: UInt8[Tensor, "h w 3"], depth: Float[Tensor, "h w"], camera: CameraTrack, most: int
) -> Gaussians:
    """The static set of a fixed camera from its temporal median of colour and depth (m, 0 = unknown).

    Args:
        median: colours of the empty scene.
        depth: z-depth of the empty scene.
        camera: the camera; its first frame counts.
        most: bound on the number of Gaussians; above it every second, third, ... pixel is used.
    """
    step = max(1, math.ceil(math.sqrt(depth.numel() / most)))
    return pixel_gaussians(median, fill_depth(depth), camera, 0, step)[0]


def look_at_distance(depth: Float[Tensor, "h w"]) -> float:
    """Distance (m) to what the camera looks at: the median known depth of the middle of the image."""
    h, w = depth.shape
    middle = depth[h // 4 : h - h // 4, w // 4 : w - w // 4]
    known = middle[middle > 0]
    if known.numel() == 0:
        known = depth[depth > 0]
    return float(known.median()) if known.numel() else 1.0
