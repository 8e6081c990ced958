"""`rasterize`: checks what it is given and hands it to a backend."""

import logging
from collections.abc import Callable
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.errors import RenderError
from lerobot_msdyn.render.availability import cuda_problem
from lerobot_msdyn.render.reference import rasterize_reference
from lerobot_msdyn.render.types import MAX_CPU_CHANNELS, Raster
from lerobot_msdyn.render.validation import check_shapes

BACKENDS = ("auto", "reference", "cpu", "cuda")

_log = logging.getLogger(__name__)


def rasterize(
    means: Float[Tensor, "*#views g 3"],
    quats: Float[Tensor, "*#views g 4"],
    scales: Float[Tensor, "*#views g 3"],
    opacities: Float[Tensor, "*#views g"],
    features: Float[Tensor, "*#views g c"],
    camera_from_world: Float[Tensor, "b 4 4"],
    intrinsics: Float[Tensor, "b 3 3"],
    width: int,
    height: int,
    *,
    backend: str = "auto",
    near: float = 0.01,
) -> Raster:
    """Render Gaussians into a batch of views, differentiably in everything but the intrinsics.

    Gaussian tensors are shared by all views, or hold one set per view (a leading `b`), each independently.

    Args:
        means: centres, m.
        quats: orientations wxyz, of any length but zero.
        scales: standard deviations along the own axes, m (linear, not logarithms).
        opacities: 0..1 (not logits).
        features: what is blended: colours, masks, positions, ...
        camera_from_world: view matrices (OpenCV axes), m.
        intrinsics: pinhole matrices, px.
        width: of the images, px.
        height: of the images, px.
        backend: "reference" (torch), "cpu" (numba), "cuda" (gsplat) or "auto": the fastest one that is
            available on the device of `means`.
        near: Gaussians whose centre is at this z-depth (m) or nearer are not rendered; above 0.

    Raises:
        RenderError: a tensor has a wrong shape, dtype, device or value, or the backend cannot be used.
    """
    gaussians = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "features": features,
    }
    check_shapes(gaussians, {"camera_from_world": camera_from_world, "intrinsics": intrinsics}, width, height)
    if not near > 0:
        raise RenderError(f"near is {near} m; expected a positive distance")
    if backend not in BACKENDS:
        raise RenderError(f"backend is {backend!r}; expected one of {', '.join(BACKENDS)}")
    if backend == "auto":
        backend = _best_backend(means, features)
    implementation, problem = _load(backend)
    if implementation is None:
        raise RenderError(f"backend {backend!r} cannot be used: {problem}; use backend='reference'")
    return implementation(means, quats, scales, opacities, features, camera_from_world, intrinsics, width, height, near)


def _best_backend(means: Tensor, features: Tensor) -> str:
    """The fastest usable backend; the reference for float64 and for more channels than a backend takes."""
    backend = means.device.type
    limits = {"cpu": MAX_CPU_CHANNELS, "cuda": features.shape[-1]}
    if means.dtype != torch.float32 or features.shape[-1] > limits.get(backend, -1):
        return "reference"
    implementation, problem = _load(backend)
    if implementation is None:
        _warn_once(backend, problem)
        return "reference"
    return backend


@cache
def _load(backend: str) -> tuple[Callable[..., Raster] | None, str]:
    """The function of a backend, or None and why it cannot be used."""
    if backend == "reference":
        return rasterize_reference, ""
    try:
        if backend == "cpu":
            from lerobot_msdyn.render.cpu.rasterizer import rasterize_cpu

            return rasterize_cpu, ""
        problem = cuda_problem()
        if problem:
            return None, problem
        from lerobot_msdyn.render.cuda import rasterize_cuda

        return rasterize_cuda, ""
    except (ImportError, RuntimeError, OSError) as error:  # RuntimeError: numba finds no folder for its cache
        return None, str(error)


@cache
def _warn_once(backend: str, problem: str) -> None:
    _log.warning("rasterizing in plain torch, 10 to 25 times slower: backend %r cannot be used (%s)", backend, problem)
