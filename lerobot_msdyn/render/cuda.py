"""The rasterizer for CUDA devices: gsplat, called so that it means the same as the reference."""

from gsplat import rasterization
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.render.types import Raster


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
    """Draw Gaussians with gsplat's kernels; arguments as in `rasterize`.

    gsplat takes either one scene for all views or a batch of scenes, not a mix: where one of the tensors is given
    per view, all are expanded.
    """
    views = camera_from_world.shape[0]
    ranks = ((means, 2), (quats, 2), (scales, 2), (opacities, 1), (features, 2))
    shared = all(values.ndim == rank for values, rank in ranks)
    if not shared:
        means, quats, scales, opacities, features = (
            values if values.ndim > rank else values.expand(views, *values.shape) for values, rank in ranks
        )
        camera_from_world, intrinsics = camera_from_world[:, None], intrinsics[:, None]
    images, alpha, _ = rasterization(
        means,
        quats,
        scales,
        opacities,
        features,
        camera_from_world,
        intrinsics,
        width,
        height,
        near_plane=near,
        render_mode="RGB+ED",
        packed=False,
    )
    if not shared:
        images, alpha = images[:, 0], alpha[:, 0]
    return Raster(images[..., :-1], images[..., -1], alpha[..., 0])
