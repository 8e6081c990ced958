"""The rasterizer for CPUs: numba kernels with explicit SIMD, and their gradient, behind torch's autograd."""

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from lerobot_msdyn.core.errors import RenderError
from lerobot_msdyn.render.backdrop import Painted, Splats
from lerobot_msdyn.render.cpu.binning import list_per_tile
from lerobot_msdyn.render.cpu.compositing import composite_backward, composite_forward
from lerobot_msdyn.render.cpu.planes import Layout, layout_for
from lerobot_msdyn.render.cpu.projection import CHUNK, paint_backdrop, project_backward, project_forward
from lerobot_msdyn.render.cpu.records import HEAD
from lerobot_msdyn.render.cpu.threads import run
from lerobot_msdyn.render.cpu.tiles import TILE_HEIGHT, TILE_WIDTH
from lerobot_msdyn.render.types import MAX_CPU_CHANNELS, Raster
from lerobot_msdyn.render.validation import check_cameras, check_values

_REUSED = 1 << 22  # numbers (16 MiB) up to which a thread holds on to memory
_NONE = np.empty(0, np.float32)
_NOTHING = Splats(np.empty(0, np.int32), np.empty((0, HEAD), np.float32), _NONE)
_USUAL_CHANNELS = 4  # of pictures of scenes, whose kernels serve to project backdrops as well
_local = threading.local()


def rasterize_cpu(
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
    backdrop: Painted | None = None,
) -> Raster:
    """Render Gaussians in float32 with up to 16 feature channels; arguments as in `rasterize`.

    With a backdrop (of this backend) there are no gradients.

    Raises:
        RenderError: tensors are not float32 on the CPU, there are too many channels, or a value is not finite or
            out of range.
    """
    if means.dtype != torch.float32 or means.device.type != "cpu":
        raise RenderError(
            f"backend 'cpu' got {means.dtype} on {means.device}; expected torch.float32 on cpu "
            "(backend='reference' takes any)"
        )
    if features.shape[-1] > MAX_CPU_CHANNELS:
        raise RenderError(
            f"backend 'cpu' got {features.shape[-1]} feature channels; expected at most {MAX_CPU_CHANNELS} "
            "(render the others in a second call)"
        )
    gaussians = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "features": features}
    cameras = {"camera_from_world": camera_from_world, "intrinsics": intrinsics}
    if not _usable(*_arrays(*cameras.values())):
        check_cameras(**cameras)
    batched = [
        values if values.ndim == ndim else values[None]
        for values, ndim in zip(gaussians.values(), (3, 3, 3, 2, 3), strict=True)
    ]
    try:
        image, depth, alpha = _Rasterize.apply(*batched, *cameras.values(), width, height, near, backdrop)
    except _RefusedError:
        check_values(gaussians | ({} if backdrop is None else {"the backdrop's features": backdrop.features}), cameras)
        raise
    return Raster(image.permute(0, 2, 3, 1), depth, alpha)


@torch.no_grad()
def project_cpu(
    means: Float[Tensor, "s 3"],
    quats: Float[Tensor, "s 4"],
    scales: Float[Tensor, "s 3"],
    opacities: Float[Tensor, " s"],
    camera_from_world: Float[Tensor, "4 4"],
    intrinsics: Float[Tensor, "3 3"],
    width: int,
    height: int,
    near: float,
) -> Splats:
    """Project Gaussians that keep still before a camera; arguments as in `rasterize`.

    Raises:
        RenderError: a value is not finite or out of range.
    """
    gaussians = [means, quats, scales, opacities, means.new_zeros(len(means), _USUAL_CHANNELS)]
    cameras = {"camera_from_world": camera_from_world[None], "intrinsics": intrinsics[None]}
    check_cameras(**cameras)
    inputs = *(values[None] for values in gaussians), *cameras.values()
    try:
        projected = _project(inputs, width, height, near, kept=True)
    except _RefusedError:
        names = ("means", "quats", "scales", "opacities")
        check_values(dict(zip(names, gaussians, strict=False)), cameras)
        raise
    seen = np.flatnonzero(projected.counts[0])
    sources = seen[np.argsort(projected.depths[0, seen], kind="stable")].astype(np.int32)
    heads = projected.records.reshape(len(means), projected.layout.record)[sources, :HEAD]
    return Splats(sources, np.ascontiguousarray(heads), projected.depths[0, sources])


def _usable(poses: np.ndarray, intrinsics: np.ndarray) -> bool:
    """`check_cameras` without its messages, at a tenth of its time."""
    finite = np.isfinite(poses).all() and np.isfinite(intrinsics).all()
    return bool(finite and (intrinsics[:, (0, 1), (0, 1)] > 0).all())


class _RefusedError(RenderError):
    """A kernel met a number that cannot be rendered; `check_values` finds out which."""


@dataclass(frozen=True)
class _Projected:
    """What the forward pass keeps for the backward pass, besides its inputs and outputs."""

    layout: Layout
    records: np.ndarray  # float32, flat: [b, g, layout.record]; Gaussians of a backdrop come first
    counts: np.ndarray  # int32 [b, g], tiles that a Gaussian meets
    depths: np.ndarray  # float32 [b, g], m, of those that meet any
    offsets: np.ndarray  # int64 [b, g], first gradient slot of a Gaussian, if slots are kept
    starts: np.ndarray  # int64 [b, tiles + 1], where each tile's list starts
    listed: np.ndarray  # int32, Gaussians, list after list
    slots: np.ndarray  # int64, gradient slots of the list entries, if they are kept
    ends: np.ndarray  # int64 [b, tiles], where each tile's list stopped to matter


def _arrays(*tensors: Tensor) -> list[np.ndarray]:
    return [tensor.detach().contiguous().numpy() for tensor in tensors]


def _records(size: int, *, kept: bool) -> np.ndarray:
    """Uninitialised float32; memory of this thread that its next call uses again, unless it is `kept`.

    Fresh memory of this size costs more to get, page by page, than to fill.
    """
    if kept or size > _REUSED:
        return np.empty(size, np.float32)
    if getattr(_local, "records", _NONE).size < size:
        _local.records = np.empty(size, np.float32)
    return _local.records[:size]


def _project(
    inputs: tuple[Tensor, ...], width: int, height: int, near: float, backdrop: Painted | None = None, *, kept: bool
) -> _Projected:
    """Project and list per tile; `kept`: for the backward pass."""
    features, cameras = inputs[4:6]
    splats = _NOTHING if backdrop is None else backdrop.backdrop.splats
    assert splats is not None
    ahead, views = len(splats.heads), cameras.shape[0]
    count, layout = ahead + features.shape[1], layout_for(features.shape[2])
    records = _records(views * count * layout.record, kept=kept)
    rects = np.empty((views, count, 4), np.int16)
    counts, depths = np.empty((views, count), np.int32), np.empty((views, count), np.float32)
    refused = np.zeros(1, np.int32)
    out = (records, rects, counts, depths, refused)
    if backdrop is not None:
        gains, hidden = torch.atleast_2d(backdrop.gains, backdrop.hidden)
        run(
            paint_backdrop, views * -(-ahead // CHUNK), splats.sources, splats.heads, splats.depths,
            *_arrays(backdrop.plain, gains, hidden), width, height, layout, *out,
        )  # fmt: skip
    run(
        project_forward, views * -(-(count - ahead) // CHUNK), *_arrays(*inputs), width, height, np.float32(near),
        layout, ahead, *out,
    )  # fmt: skip
    if refused[0]:
        raise _RefusedError("a Gaussian holds a number that cannot be rendered; backend='reference' may take it")
    ends_of_views = counts.sum(1, dtype=np.int64).cumsum()
    entries = int(ends_of_views[-1]) if views else 0
    offsets = np.empty((views, count if kept else 0), np.int64)
    across, down = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    starts, ends = np.empty((views, across * down + 1), np.int64), np.empty((views, across * down), np.int64)
    listed, slots = np.empty(entries, np.int32), np.empty(entries if kept else 0, np.int64)
    run(list_per_tile, views, ahead, counts, depths, rects, ends_of_views, across, starts, listed, offsets, slots)
    return _Projected(layout, records, counts, depths, offsets, starts, listed, slots, ends)


class _Rasterize(torch.autograd.Function):
    """means, quats, scales, opacities, features (all with a leading 1 or b), poses -> image, depth, alpha."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
        inputs, (width, height, near, backdrop) = arguments[:7], arguments[7:]
        projected = _project(inputs, width, height, near, backdrop, kept=any(ctx.needs_input_grad))
        views, channels = inputs[5].shape[0], inputs[4].shape[2]
        image = torch.empty(views, channels, height, width)
        depth, alpha = torch.empty(views, height, width), torch.empty(views, height, width)
        run(
            composite_forward, projected.ends.size, projected.starts, projected.listed, projected.records,
            projected.counts.shape[1], channels, width, height, projected.layout, projected.ends,
            image.numpy().reshape(-1), depth.numpy().reshape(-1), alpha.numpy().reshape(-1),
        )  # fmt: skip
        ctx.save_for_backward(*inputs, image, depth, alpha)
        ctx.projected, ctx.size = projected, (width, height)
        return image, depth, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        inputs, outputs = ctx.saved_tensors[:7], ctx.saved_tensors[7:]
        (width, height), projected = ctx.size, ctx.projected
        views, count, channels = inputs[5].shape[0], inputs[0].shape[1], inputs[4].shape[2]
        sums = np.empty((len(projected.listed), projected.layout.sums), np.float32)
        run(
            composite_backward, projected.ends.size, projected.starts, projected.listed, projected.slots,
            projected.ends, projected.records, count, channels, width, height, projected.layout,
            *(array.reshape(-1) for array in _arrays(*outputs, *gradients)), sums,
        )  # fmt: skip
        gaussians = [np.zeros(values.shape, np.float32) for values in inputs[:5]]
        blocks = -(-count // CHUNK)
        poses = np.zeros((blocks, views, 4, 4), np.float32)
        run(
            project_backward, blocks, *_arrays(*inputs[:4], *inputs[5:]), width, height,
            projected.counts, projected.offsets, sums, *gaussians, poses,
        )  # fmt: skip
        return *(torch.from_numpy(array) for array in (*gaussians, poses.sum(0))), *[None] * 5
