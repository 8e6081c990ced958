"""The rasterizer for CUDA devices: gsplat, called so that it means the same as the reference (docs/render.md)."""

import torch
from gsplat import rasterization
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from lerobot_msdyn.core.errors import RenderError
from lerobot_msdyn.core.geometry import transform_points
from lerobot_msdyn.render.reference import rasterize_reference, renderable
from lerobot_msdyn.render.types import COVARIANCE_BLUR, QUAT_LENGTHS, Raster
from lerobot_msdyn.render.validation import check_values

WARP = 32  # threads that add their gradients up before they are written


def rasterize_cuda(
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
    """Render Gaussians in float32 with gsplat's kernels; arguments as in `rasterize`.

    Raises:
        RenderError: tensors are not float32 on a CUDA device, or a value is not finite or out of range.
    """
    if means.dtype != torch.float32 or means.device.type != "cuda":
        raise RenderError(
            f"backend 'cuda' got {means.dtype} on {means.device}; expected torch.float32 on cuda "
            "(backend='reference' takes any)"
        )
    tensors = (means, quats, scales, opacities, features, camera_from_world, intrinsics)
    if means.shape[-2] == 0:  # gsplat takes no empty scene
        return rasterize_reference(*tensors, width, height, near)
    usable = _usable(*tensors)
    raster = render_with_gsplat(*tensors, width, height, near)
    if not usable:  # read only now: gsplat has waited for the device already
        check_values(
            {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "features": features},
            {"camera_from_world": camera_from_world, "intrinsics": intrinsics},
        )
    return raster


def render_with_gsplat(
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
    """The same, unchecked, of one Gaussian or more.

    gsplat takes either one scene for all views or one for each, not a mix: all tensors are given per view. What the
    reference does not render gets an opacity of zero, by which gsplat leaves it out as well. So do Gaussians that are
    added to fill the last warp of each view: gsplat 1.5 adds up the gradients of poses within a warp, whatever views
    its threads belong to.
    """
    views = len(camera_from_world)
    means, quats, scales, opacities, features = (
        values if values.ndim > rank else values.expand(views, *values.shape)
        for values, rank in ((means, 2), (quats, 2), (scales, 2), (opacities, 1), (features, 2))
    )
    missing = -means.shape[1] % WARP if views > 1 else 0
    if missing:
        means, scales, features = (pad(values, (0, 0, 0, missing)) for values in (means, scales, features))
        quats, opacities = pad(quats, (0, 0, 0, missing), value=1.0), pad(opacities, (0, missing))
    with torch.no_grad():
        shown = renderable(transform_points(camera_from_world, means), scales, opacities, intrinsics, near)
    images, alpha, _ = rasterization(
        means,
        quats,
        scales,
        torch.where(shown, opacities, 0.0),
        features,
        camera_from_world[:, None],
        intrinsics.detach()[:, None],
        width,
        height,
        near_plane=near,
        eps2d=COVARIANCE_BLUR,
        packed=False,
        render_mode="RGB+ED",
        rasterize_mode="classic",
    )
    return Raster(images[:, 0, ..., :-1], images[:, 0, ..., -1], alpha[:, 0, ..., 0])


@torch.no_grad()
def _usable(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, features: Tensor, poses: Tensor, intrinsics: Tensor
) -> Bool[Tensor, ""]:
    """False where `check_values` would complain, without waiting for the device; rarely also where it would not."""
    everything = (means, quats, scales, opacities, features, poses, intrinsics)
    sums = torch.stack([values.sum() for values in everything])  # one NaN or Inf among the summands is in the sum
    low, high = opacities.aminmax()
    shortest, longest = quats.norm(dim=-1).aminmax()
    focal = intrinsics.diagonal(dim1=-2, dim2=-1)[:, :2]
    within = (scales.amin() >= 0) & (low >= 0) & (high <= 1) & (focal.amin() > 0)
    return sums.isfinite().all() & within & (shortest >= QUAT_LENGTHS[0]) & (longest <= QUAT_LENGTHS[1])
