"""gsplat's own Python, with its kernels replaced by plain torch: by gsplat's torch versions where it has them."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch
from torch import Tensor

ALPHA_CAP = 0.999  # of gsplat 1.5; 0.99 from 1.6 on


@contextmanager
def gsplat_on_cpu() -> Iterator[None]:
    """Within, `gsplat.rasterization` runs on the CPU, in any float type, differentiably."""
    from gsplat import rendering
    from gsplat.cuda import _torch_impl

    def isect_tiles(means2d: Tensor, radii: Tensor, depths: Tensor, size: int, across: int, down: int, **_: Any) -> Any:
        return _torch_impl._isect_tiles(means2d, radii, depths, size, across, down)

    with (
        mock.patch.object(rendering, "fully_fused_projection", _projected),
        mock.patch.object(rendering, "isect_tiles", isect_tiles),
        mock.patch.object(rendering, "isect_offset_encode", _torch_impl._isect_offset_encode),
        mock.patch.object(rendering, "rasterize_to_pixels", _composited),
    ):
        yield


def _projected(
    means: Tensor, covars: None, quats: Tensor, scales: Tensor, viewmats: Tensor, intrinsics: Tensor, *size: int,
    opacities: Tensor, packed: bool, radius_clip: float, sparse_grad: bool, **options: Any,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    """As the kernel ProjectionEWA3DGSFused: no radius for what is fainter than 1/255.

    Its backward pass adds up the gradients of poses within a warp of 32 threads, one per Gaussian and view, and gives
    them all to the first one's view.
    """
    from gsplat.cuda import _torch_impl

    assert covars is None
    assert not packed
    assert radius_clip == 0
    assert viewmats.shape[:-2].numel() == 1 or means.shape[-2] % 32 == 0, "a warp must not have two views"
    covariance, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    radii, *others = _torch_impl._fully_fused_projection(means, covariance, viewmats, intrinsics, *size, **options)
    faint = (opacities < 1 / 255)[..., None, :, None]
    return radii.masked_fill(faint, 0), *others


def _composited(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, width: int, height: int, tile_size: int,
    isect_offsets: Tensor, flatten_ids: Tensor, backgrounds: None, packed: bool, absgrad: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """As the kernel RasterizeToPixels3DGSFwd, a thread of which renders a pixel; here all pixels of a tile at once."""
    leading, channels = colors.shape[:-2], colors.shape[-1]
    centres, shapes = means2d.reshape(-1, 2), conics.reshape(-1, 3)
    values, opaque = colors.reshape(-1, channels), opacities.reshape(-1)
    offsets = isect_offsets.flatten()
    across, down = isect_offsets.shape[-1], isect_offsets.shape[-2]
    tiles = []
    for number, start in enumerate(offsets.tolist()):
        end = int(offsets[number + 1]) if number + 1 < len(offsets) else len(flatten_ids)
        y, x = torch.meshgrid(torch.arange(tile_size) + 0.5, torch.arange(tile_size) + 0.5, indexing="ij")
        place = torch.stack((x + number % across * tile_size, y + number // across % down * tile_size), dim=-1)
        transmittance, done = torch.ones_like(x, dtype=colors.dtype), torch.zeros_like(x, dtype=torch.bool)
        picture = colors.new_zeros(tile_size, tile_size, channels)
        for g in flatten_ids[start:end].tolist():
            dx, dy = (centres[g] - place).unbind(-1)
            sigma = 0.5 * (shapes[g, 0] * dx * dx + shapes[g, 2] * dy * dy) + shapes[g, 1] * dx * dy
            alpha = (opaque[g] * torch.exp(-sigma)).clamp(max=ALPHA_CAP)
            seen = (sigma >= 0) & (alpha >= 1 / 255) & ~done
            after = transmittance * (1 - alpha)
            done = done | (seen & (after <= 1e-4))
            seen = seen & ~done
            weight = torch.where(seen, alpha * transmittance, 0.0)
            picture = picture + weight[..., None] * values[g]
            transmittance = torch.where(seen, after, transmittance)
        tiles.append(torch.cat((picture, 1 - transmittance[..., None]), dim=-1))
    grid = torch.stack(tiles).reshape(-1, down, across, tile_size, tile_size, channels + 1)
    image = grid.permute(0, 1, 3, 2, 4, 5).reshape(*leading, down * tile_size, across * tile_size, channels + 1)
    image = image[..., :height, :width, :]
    return image[..., :-1], image[..., -1:]
