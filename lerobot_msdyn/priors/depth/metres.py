"""Depth of any kind in metres: what has no scale is aligned to depth that has one."""

import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.observations import DepthTraits, Origin
from lerobot_msdyn.priors.depth.align import align_disparity, align_scale
from lerobot_msdyn.priors.depth.blurred_edges import sharpened
from lerobot_msdyn.priors.depth.flying_pixels import without_flying_pixels
from lerobot_msdyn.priors.depth.fuse import fused
from lerobot_msdyn.priors.depth.parallax import bent_to
from lerobot_msdyn.priors.exchange import AFFINE_DISPARITY, METRIC
from lerobot_msdyn.priors.provide import best
from lerobot_msdyn.priors.registry import Depth, DepthProvider, Estimate, Masks
from lerobot_msdyn.priors.request import Request


def in_metres(
    request: Request,
    instances: Masks,
    values: Float[Tensor, "t h w"],
    kind: str,
    *,
    trusted: bool,
    elsewhere: Float[Tensor, "m h w"] | None = None,
) -> Estimate[Depth]:
    """Depth without blurred edges: what is near a surface is put on it, and what floats becomes unknown.

    Before a fixed camera, depth whose reference is a ground is put together with it (`priors.depth.fuse`); before one
    that moves, it is bent to the corners that its way tells (`priors.depth.parallax`).

    Args:
        request: the video; other depth of it is the reference.
        instances: what moves; an assumed reference is not asked there.
        values: what was predicted.
        kind: `metric` (m), `scale` (lacks a factor) or `affine_disparity` (inverse depth that lacks a factor and a
            shift, larger = nearer).
        trusted: whether metres are true ones. Those of a network are those of an unknown focal length: a reference in
            true metres corrects them where there is one. What a known ground contradicts is corrected in any case.
        elsewhere: what was predicted of frames of all episodes of this camera.

    Raises:
        PriorError: the values cannot be aligned to the reference.
    """
    reference, origin = reference_depth(request, instances)
    true_metres = reference.traits.metric
    ground_known = reference.ground is not None and true_metres and request.view.camera.is_static
    if kind == METRIC and trusted and not ground_known:
        z = torch.where(torch.isfinite(values), values, 0.0).clamp(min=0)
        return _clean(z, True, "in metres")
    if kind == METRIC and not true_metres:
        return _clean(values, False, "in the network's own metres")
    how = f"scaled{' and shifted' if kind == AFFINE_DISPARITY else ''} to {origin.provider}"
    if reference.ground is not None and request.view.camera.is_static:
        beyond = None if elsewhere is None else _inverse(elsewhere, kind)
        z = fused(
            _inverse(values, kind),
            instances,
            reference.ground,
            reference.z,
            beyond,
            shifted=kind == AFFINE_DISPARITY,
            known=not reference.traits.assumed,
        )
        return _clean(z, true_metres, how, reference.ground)
    usable = None if reference.traits.measured else instances == 0
    align = align_disparity if kind == AFFINE_DISPARITY else align_scale
    z = align(values, reference.z, usable)
    if reference.corners is not None:
        unit_m, points = reference.corners.unit_m, reference.corners.points
        bent = bent_to((z / unit_m).numpy(), points, request.view.camera, instances.numpy())
        z = unit_m * torch.from_numpy(bent)
    return _clean(z, true_metres, how)


def reference_depth(request: Request, instances: Masks) -> tuple[Depth, Origin]:
    """The best depth that other depth may be aligned to: `DepthProvider.is_reference`."""
    return best(
        DepthProvider,
        request,
        lambda provider: provider.reference(request, instances),
        among=lambda provider: provider.is_reference,
    )


def _inverse(values: Float[Tensor, "n h w"], kind: str) -> Float[Tensor, "n h w"]:
    """Inverse depth, up to what its kind lacks; not finite = unknown."""
    return values if kind == AFFINE_DISPARITY else torch.where(values > 0, values, torch.nan).reciprocal()


def _clean(
    z: Float[Tensor, "t h w"], true_metres: bool, how: str, ground: Float[Tensor, "h w"] | None = None
) -> Estimate[Depth]:
    return Estimate(Depth(without_flying_pixels(sharpened(z)), DepthTraits(true_metres), ground), how)
