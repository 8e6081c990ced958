"""What the ablation compares with that the library lacks: pictures warped by depth, and a field that is learned."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from ablation_scenes import Case, HeldOut
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import project, transform_points, unproject_image
from lerobot_msdyn.motion.model.compose import Level
from lerobot_msdyn.priors import Priors
from lerobot_msdyn.reconstruction.background import EmptyScene
from lerobot_msdyn.scene.dynamic import DynamicScene

FIELD_RATE = 1e-3  # of a deformation field's layers ...
LAYERS = ("first", "hidden", "biases", "last")  # ... which are these
LEAST_WEIGHT = 0.05  # of a pixel that something was splatted on
SAME_SURFACE_M, SAME_SURFACE = 0.006, 0.008  # behind the nearest point, at most this and this share of its depth
CRACK_NEIGHBOURS = 5  # of eight, that close a crack
FILL_RADIUS_PX = 3

Splat = tuple[Float32[ndarray, "h w 3"], Float32[ndarray, "h w"]]  # colours 0..255, and their weight


def warped_pictures(
    case: Case, priors: Priors, empty: EmptyScene, heldout: HeldOut
) -> Iterator[UInt8[ndarray, "h w 3"]]:
    """Each recorded frame warped by its depth, with the warped empty scene where nothing lands; other holes filled."""
    recorded = case.view.camera
    for i, frame in enumerate(heldout.frames.tolist()):
        target, source = heldout.camera.select([i]), recorded.select([frame])
        colours, weight = closed(*splat(case.view.rgb[frame], priors.depth[frame], source, target))
        behind, density = splat(empty.rgb, torch.where(empty.seen > 0, empty.depth, 0.0), source, target)
        taken = (weight <= LEAST_WEIGHT) & (density > LEAST_WEIGHT)
        colours[taken], weight[taken] = behind[taken], density[taken]
        holes = (weight <= LEAST_WEIGHT).astype(np.uint8)
        yield cv2.inpaint(colours.clip(0, 255).round().astype(np.uint8), holes, FILL_RADIUS_PX, cv2.INPAINT_TELEA)


def splat(rgb: UInt8[Tensor, "h w 3"], depth: Float[Tensor, "h w"], source: CameraTrack, target: CameraTrack) -> Splat:
    """Pixels of known depth (m) spread over the four nearest pixels of another view; the nearest surface wins."""
    height, width = depth.shape
    world = transform_points(source.world_from_camera[0], unproject_image(depth, source.intrinsics[0]).reshape(-1, 3))
    xy, z = project(transform_points(target.camera_from_world[0], world), target.intrinsics[0])
    valid = (depth.reshape(-1) > 0) & (z > 0)
    at, z, values = xy[valid] - 0.5, z[valid], rgb.reshape(-1, 3)[valid].float()
    low = at.floor()
    corner = torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
    cells = low.long()[:, None] + corner
    overlap = (1 - (at[:, None] - low[:, None] - corner).abs()).prod(-1)
    inside = ((cells >= 0) & (cells < torch.tensor([width, height]))).all(-1)
    point, which = inside.nonzero(as_tuple=True)
    cell = cells[point, which, 1] * width + cells[point, which, 0]
    overlap, z = overlap[point, which], z[point]
    nearest = torch.full((height * width,), torch.inf)
    sure = overlap > LEAST_WEIGHT
    nearest.scatter_reduce_(0, cell[sure], z[sure], "amin")
    shown = z < nearest[cell] * (1 + SAME_SURFACE) + SAME_SURFACE_M
    cell, overlap, point = cell[shown], overlap[shown], point[shown]
    weight = torch.zeros(height * width).index_add_(0, cell, overlap)
    total = torch.zeros(height * width, 3).index_add_(0, cell, overlap[:, None] * values[point])
    colours = total / weight.clamp(min=1e-9)[:, None]
    return colours.reshape(height, width, 3).numpy(), weight.reshape(height, width).numpy()


def closed(colours: Float32[ndarray, "h w 3"], weight: Float32[ndarray, "h w"]) -> Splat:
    """A splat whose cracks of a pixel or two are closed, so that nothing shines through them."""
    for _ in range(2):
        covered: Bool[ndarray, "h w"] = weight > LEAST_WEIGHT
        count = _sum_of_window(covered.astype(np.float32))
        crack = ~covered & (count >= CRACK_NEIGHBOURS)
        mean = _sum_of_window(np.where(covered[..., None], colours, np.float32(0)))
        colours = np.where(crack[..., None], mean / np.maximum(count, 1)[..., None], colours)
        weight = np.where(crack, np.float32(1), weight)
    return colours, weight


def _sum_of_window(image: ndarray) -> ndarray:
    return cv2.boxFilter(image, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)


def with_learned_field(scene: DynamicScene, *, afresh: bool) -> tuple[DynamicScene, list[dict[str, Any]]]:
    """A scene whose deformation field takes part in the fit, and the groups of parameters that Adam needs for that.

    `afresh`: it begins without any motion (Yang et al. 2024, Deformable 3D Gaussians).
    """
    levels: list[Level] = []
    groups: list[dict[str, Any]] = []
    for level in scene.levels:
        assert is_dataclass(level)
        leaves = {name: getattr(level, name).clone() for name in LAYERS}
        if afresh:
            leaves["last"].zero_()
        groups += [{"params": [leaf.requires_grad_()], "lr": FIELD_RATE} for leaf in leaves.values()]
        levels.append(replace(level, **leaves))
    return replace(scene, levels=tuple(levels)), groups


def with_fixed_field(scene: DynamicScene) -> DynamicScene:
    """The same scene after the fit: nothing is learned any more."""
    levels: list[Level] = []
    for level in scene.levels:
        assert is_dataclass(level)
        levels.append(replace(level, **{item.name: getattr(level, item.name).detach() for item in fields(level)}))
    return replace(scene, levels=tuple(levels))
