"""The rasterizer in plain torch, differentiated by autograd: the definition that other backends must match.

Forward model: Kerbl et al. 2023 ("3D Gaussian Splatting"), section 4 to 6, with the conventions of gsplat 1.5
(`classic` mode). Vectorised over small tiles: each tile takes the depth-sorted list of the Gaussians that can
reach it; lists of similar length are padded and composited together.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.geometry import quaternion_to_matrix
from lerobot_msdyn.render.types import (
    COVARIANCE_BLUR,
    FURTHEST,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    TANGENT_MARGIN,
    Raster,
)
from lerobot_msdyn.render.validation import check_values

TILE = 8  # px, side of a tile
_BATCH_ELEMENTS = 3_000_000  # tiles x Gaussians x pixels composited together; bounds the memory of one step
_MAX_PADDING = 2  # the shortest list of a batch is at least this fraction of the longest


@dataclass(frozen=True)
class _Splats:
    """Projected Gaussians, one row per (view, Gaussian) pair that lies before the near plane."""

    view: Int[Tensor, " n"]
    center: Float[Tensor, "n 2"]  # px
    covariance: Float[Tensor, "n 2 2"]  # px²
    determinant: Float[Tensor, " n"]  # px⁴, of the covariance
    depth: Float[Tensor, " n"]  # m
    opacity: Float[Tensor, " n"]
    features: Float[Tensor, "n c"]


@dataclass(frozen=True)
class _TileLists:
    """For every tile of every view, the rows of its Gaussians from near to far, one list after the other."""

    row: Int[Tensor, " m"]
    count: Int[Tensor, " tiles"]
    across: int  # tiles in a row of the image
    down: int  # tiles in a column of the image


def rasterize_reference(
    means: Float[Tensor, "*#views g 3"],
    quats: Float[Tensor, "*#views g 4"],
    scales: Float[Tensor, "*#views g 3"],
    opacities: Float[Tensor, "*#views g"],
    features: Float[Tensor, "*#views g c"],
    camera_from_world: Float[Tensor, "b 4 4"],
    intrinsics: Float[Tensor, "b 3 3"],
    width: int,
    height: int,
    near: float,
) -> Raster:
    """Render Gaussians in float32 or float64 on any device; arguments as in `rasterize`.

    Raises:
        RenderError: a value is not finite or out of range.
    """
    check_values(
        {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "features": features},
        {"camera_from_world": camera_from_world, "intrinsics": intrinsics},
    )
    splats = _project(means, quats, scales, opacities, features, camera_from_world, intrinsics, width, height, near)
    lists = _list_per_tile(splats, camera_from_world.shape[0], width, height)
    image = _composite(splats, lists, camera_from_world.shape[0], width, height)
    channels = features.shape[-1]
    depth_sum, alpha = image[..., channels], image[..., channels + 1]
    depth = depth_sum / torch.where(alpha > 0, alpha, torch.ones_like(alpha))
    return Raster(image[..., :channels], depth, alpha)


def _project(
    means: Float[Tensor, "*#views g 3"],
    quats: Float[Tensor, "*#views g 4"],
    scales: Float[Tensor, "*#views g 3"],
    opacities: Float[Tensor, "*#views g"],
    features: Float[Tensor, "*#views g c"],
    camera_from_world: Float[Tensor, "b 4 4"],
    intrinsics: Float[Tensor, "b 3 3"],
    width: int,
    height: int,
    near: float,
) -> _Splats:
    """Project centres and covariances (EWA splatting, Zwicker et al. 2001); drops what cannot be seen."""
    rotation = camera_from_world[:, :3, :3]
    in_camera = means @ rotation.transpose(-1, -2) + camera_from_world[:, None, :3, 3]
    views, count = in_camera.shape[:2]
    view, gaussian = renderable(in_camera, scales, opacities, intrinsics, near).nonzero(as_tuple=True)
    pair = view * count + gaussian

    def rows(values: Tensor, ndim: int) -> Tensor:
        """Rows of a Gaussian tensor that is shared (`ndim` dimensions) or given per view (one more)."""
        return values.index_select(0, gaussian) if values.ndim == ndim else values.flatten(0, 1).index_select(0, pair)

    points = in_camera.reshape(views * count, 3).index_select(0, pair)
    spread = rotation.index_select(0, view) @ (quaternion_to_matrix(rows(quats, 2)) * rows(scales, 2)[:, None, :])
    camera = intrinsics.index_select(0, view)
    jacobian = _perspective_jacobian(points, camera, width, height)
    flat_spread = jacobian @ spread
    # |p|²|q|² - (p.q)² = |p x q|²: the determinant without cancellation
    normal = torch.linalg.cross(flat_spread[:, 0], flat_spread[:, 1])
    variances = flat_spread.square().sum((1, 2))
    blur = COVARIANCE_BLUR * torch.eye(2, dtype=means.dtype, device=means.device)
    focal, principal = camera[:, [0, 1], [0, 1]], camera[:, :2, 2]
    return _Splats(
        view=view,
        center=focal * points[:, :2] / points[:, 2:] + principal,
        covariance=flat_spread @ flat_spread.transpose(-1, -2) + blur,
        determinant=normal.square().sum(1) + COVARIANCE_BLUR * (variances + COVARIANCE_BLUR),
        depth=points[:, 2],
        opacity=rows(opacities, 1),
        features=rows(features, 2),
    )


def renderable(
    in_camera: Float[Tensor, "b g 3"],
    scales: Float[Tensor, "*#views g 3"],
    opacities: Float[Tensor, "*#views g"],
    intrinsics: Float[Tensor, "b 3 3"],
    near: float,
) -> Bool[Tensor, "b g"]:
    """Which Gaussians are rendered, by their centres in the cameras (m): beyond the near plane, seen, not too large."""
    z = in_camera[..., 2]
    focal = intrinsics.diagonal(dim1=-2, dim2=-1)[:, :2].amax(1, keepdim=True)
    largest = torch.cat((in_camera[..., :2].abs(), scales.expand_as(in_camera)), dim=2).amax(2)
    return (z > near) & (opacities >= MIN_ALPHA) & (largest * focal < FURTHEST * z.clamp(min=near))


def _perspective_jacobian(
    points: Float[Tensor, "n 3"], intrinsics: Float[Tensor, "n 3 3"], width: int, height: int
) -> Float[Tensor, "n 2 3"]:
    """Derivative of the pixel position by the camera-space position; far outside the image, that at its margin."""
    focal, principal = intrinsics[:, [0, 1], [0, 1]], intrinsics[:, :2, 2]
    size = torch.tensor([width, height], dtype=points.dtype, device=points.device)
    margin = TANGENT_MARGIN * 0.5 * size / focal
    low, high = -principal / focal - margin, (size - principal) / focal + margin
    tangent = torch.clamp(points[:, :2] / points[:, 2:], low, high)
    jacobian_xy = torch.diag_embed(focal / points[:, 2:])
    return torch.cat((jacobian_xy, (-focal * tangent / points[:, 2:])[:, :, None]), dim=2)


@torch.no_grad()
def _list_per_tile(splats: _Splats, views: int, width: int, height: int) -> _TileLists:
    """Sort the Gaussians of every tile by depth.

    A Gaussian enters the tiles that meet the box around the ellipse where its alpha reaches 1/255, that is
    within sqrt(2 ln(255 opacity)) standard deviations (never above 3.33 for opacities up to 1).
    """
    across, down = -(-width // TILE), -(-height // TILE)
    reach = torch.sqrt(2 * torch.log(splats.opacity / MIN_ALPHA).clamp(min=0))[:, None]
    half = reach * splats.covariance.diagonal(dim1=1, dim2=2).sqrt()
    limits = torch.tensor([across, down], device=half.device)
    # centre of pixel i is i + 0.5; the small slack absorbs rounding
    first = (torch.floor((splats.center - half - 0.51) / TILE)).clamp(min=0).minimum(limits).long()
    last = (torch.floor((splats.center + half - 0.49) / TILE) + 1).clamp(min=0).minimum(limits).long()
    extent = (last - first).clamp(min=0)
    copies = extent[:, 0] * extent[:, 1]
    row = torch.repeat_interleave(copies)
    nth = torch.arange(len(row), device=row.device) - (torch.cumsum(copies, 0) - copies)[row]
    columns = extent[row, 0]
    x, y = first[row, 0] + nth % columns, first[row, 1] + nth // columns
    tile = (splats.view[row] * down + y) * across + x
    rank = torch.empty_like(copies)
    rank[torch.argsort(splats.depth, stable=True)] = torch.arange(len(copies), device=row.device)
    order = torch.argsort(tile * max(len(copies), 1) + rank[row])
    count = torch.bincount(tile, minlength=views * across * down)
    return _TileLists(row[order], count, across, down)


def _composite(
    splats: _Splats, lists: _TileLists, views: int, width: int, height: int
) -> Float[Tensor, "b h w channels"]:
    """Blend every tile front to back; the last two channels are the weighted depth sum and alpha."""
    values = torch.cat((splats.features, splats.depth[:, None], torch.ones_like(splats.depth)[:, None]), dim=1)
    covariance = splats.covariance
    conic = torch.stack((covariance[:, 1, 1], -covariance[:, 0, 1], covariance[:, 0, 0]), dim=1)
    conic = conic / splats.determinant[:, None]
    table = torch.cat((splats.center, conic, splats.opacity.log()[:, None], values), dim=1)
    start = torch.cumsum(lists.count, 0) - lists.count
    blended, blended_tiles = [], []
    for tiles, longest in _batches(lists.count):
        nth = torch.arange(longest, device=tiles.device)
        real = nth < lists.count[tiles][:, None]
        position = (start[tiles][:, None] + nth).clamp(max=len(lists.row) - 1)
        rows = table.index_select(0, lists.row[position].reshape(-1)).reshape(len(tiles), longest, -1)
        weights = _weights(rows[..., :6], real, _tile_origin(tiles, lists).to(table.dtype))
        blended.append(weights.transpose(1, 2) @ rows[..., 6:])
        blended_tiles.append(tiles)
    image = values.new_zeros(views * lists.across * lists.down, TILE * TILE, values.shape[1])
    if blended_tiles:
        image = image.index_copy(0, torch.cat(blended_tiles), torch.cat(blended))
    image = image.reshape(views, lists.down, lists.across, TILE, TILE, -1).transpose(2, 3)
    return image.reshape(views, lists.down * TILE, lists.across * TILE, -1)[:, :height, :width]


def _batches(count: Int[Tensor, " tiles"]) -> list[tuple[Int[Tensor, " batch"], int]]:
    """Groups of non-empty tiles with lists of similar length, and the longest length of each."""
    order = torch.argsort(count, descending=True, stable=True)
    lengths = count[order].tolist()
    total = sum(length > 0 for length in lengths)
    groups, begin = [], 0
    while begin < total:
        longest = lengths[begin]
        end = min(total, begin + max(1, _BATCH_ELEMENTS // (longest * TILE * TILE)))
        while end > begin + 1 and lengths[end - 1] * _MAX_PADDING < longest:
            end = begin + (end - begin) // 2
        groups.append((order[begin:end], longest))
        begin = end
    return groups


def _tile_origin(tiles: Int[Tensor, " batch"], lists: _TileLists) -> Float[Tensor, "batch 2"]:
    """Top left corner of each tile in its image, px."""
    x, y = tiles % lists.across, tiles // lists.across % lists.down
    return torch.stack((x, y), dim=1).float() * TILE


def _weights(
    shape: Float[Tensor, "tiles n 6"], real: Bool[Tensor, "tiles n"], origin: Float[Tensor, "tiles 2"]
) -> Float[Tensor, "tiles n pixels"]:
    """Blending weights alpha_i * prod_{j<i} (1 - alpha_j) of depth-sorted Gaussians at the pixels of their tile.

    `shape` holds centre x, y (px), the conic's xx, xy, yy (1/px²) and the log of opacity. The exponent is a
    polynomial of second degree in the pixel's position: one product of its coefficients with six monomials.
    """
    middle = origin + TILE / 2
    x, y = (shape[..., :2] - middle[:, None]).unbind(-1)
    xx, xy, yy, log_opacity = shape[..., 2:].unbind(-1)
    coefficients = torch.stack(
        (
            log_opacity - 0.5 * (xx * x * x + yy * y * y) - xy * x * y,
            xx * x + xy * y,
            yy * y + xy * x,
            -0.5 * xx,
            -xy,
            -0.5 * yy,
        ),
        dim=-1,
    )
    offset = torch.arange(TILE, dtype=shape.dtype, device=shape.device) + 0.5 - TILE / 2
    v, u = (grid.reshape(-1) for grid in torch.meshgrid(offset, offset, indexing="ij"))
    monomials = torch.stack((torch.ones_like(u), u, v, u * u, u * v, v * v))
    alpha = torch.exp(coefficients @ monomials).clamp(max=MAX_ALPHA)
    alpha = torch.where((alpha >= MIN_ALPHA) & real[:, :, None], alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat((torch.ones_like(after[:, :1]), after[:, :-1]), dim=1)
    return alpha * before * (after > MIN_TRANSMITTANCE)
