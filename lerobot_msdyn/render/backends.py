"""`rasterize`: checks what it is given and hands it to a backend."""

import logging
from collections.abc import Callable
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.errors import RenderError
from lerobot_msdyn.render.availability import cuda_problem
from lerobot_msdyn.render.backdrop import Backdrop, Painted
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
    backdrop: Painted | None = None,
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
        backdrop: further Gaussians, without gradients, which have been projected before for the pose of all views.
            It saves time where the others have none either.

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
    backend, implementation = _chosen(backend, near, means, features)
    cameras = (camera_from_world, intrinsics, width, height, near)
    if backdrop is None:
        return implementation(*gaussians.values(), *cameras)
    backdrop.check_shapes(len(camera_from_world), features.shape[-1])
    learned = torch.is_grad_enabled() and any(values.requires_grad for values in gaussians.values())
    if backend == "cpu" and backdrop.backdrop.splats is not None and not learned:
        backdrop.check_cameras(camera_from_world, intrinsics, width, height, near)
        return implementation(*gaussians.values(), *cameras, backdrop)
    return implementation(*_with_backdrop(gaussians, backdrop), *cameras)


def project_backdrop(
    means: Float[Tensor, "s 3"],
    quats: Float[Tensor, "s 4"],
    scales: Float[Tensor, "s 3"],
    opacities: Float[Tensor, " s"],
    camera_from_world: Float[Tensor, "4 4"],
    intrinsics: Float[Tensor, "3 3"],
    width: int,
    height: int,
    *,
    backend: str = "auto",
    near: float = 0.01,
    once: bool = False,
) -> Backdrop:
    """Gaussians that keep still before a camera that does, for many pictures; other arguments as in `rasterize`.

    Only the CPU backend projects them now; others do in every picture, and so does the CPU backend if the backdrop is
    for `once`: a single picture.

    Raises:
        RenderError: a tensor has a wrong shape, dtype, device or value, or the backend cannot be used.
    """
    features = means.new_zeros(len(means), 1)
    gaussians = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "features": features}
    cameras = {"camera_from_world": camera_from_world[None], "intrinsics": intrinsics[None]}
    check_shapes(gaussians, cameras, width, height)
    splats = None
    if _chosen(backend, near, means, features)[0] == "cpu" and not once:
        from lerobot_msdyn.render.cpu.rasterizer import project_cpu

        splats = project_cpu(means, quats, scales, opacities, camera_from_world, intrinsics, width, height, near)
    return Backdrop(means, quats, scales, opacities, camera_from_world, intrinsics, width, height, near, splats)


def _with_backdrop(gaussians: dict[str, Tensor], painted: Painted) -> list[Tensor]:
    """Means, quats, scales, opacities and features of all Gaussians, those of a backdrop first."""
    joined = []
    for name, values in gaussians.items():
        first = getattr(painted if name in ("opacities", "features") else painted.backdrop, name)
        if first.ndim < values.ndim:
            first = first.expand(len(values), *first.shape)
        if values.ndim < first.ndim:
            values = values.expand(len(first), *values.shape)
        joined.append(torch.cat((first, values), dim=-1 if name == "opacities" else -2))
    return joined


def _chosen(backend: str, near: float, means: Tensor, features: Tensor) -> tuple[str, Callable[..., Raster]]:
    """The backend that is meant, and its function.

    Raises:
        RenderError: there is no such backend, it cannot be used, or the near plane is not before the camera.
    """
    if not near > 0:
        raise RenderError(f"near is {near} m; expected a positive distance")
    if backend not in BACKENDS:
        raise RenderError(f"backend is {backend!r}; expected one of {', '.join(BACKENDS)}")
    if backend == "auto":
        backend = _best_backend(means, features)
    implementation, problem = _load(backend)
    if implementation is None:
        raise RenderError(f"backend {backend!r} cannot be used: {problem}; use backend='reference'")
    return backend, implementation


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
