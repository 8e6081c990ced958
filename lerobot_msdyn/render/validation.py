"""Refuses what cannot be rendered, naming the tensor and the first bad place."""

import torch
from torch import Tensor

from lerobot_msdyn.core.errors import RenderError
from lerobot_msdyn.render.types import QUAT_LENGTHS

# tensor -> its shape after the optional leading view dimension; "g" is shared, "c" is free
_GAUSSIAN_SHAPES = {
    "means": ("g", 3),
    "quats": ("g", 4),
    "scales": ("g", 3),
    "opacities": ("g",),
    "features": ("g", "c"),
}


def check_shapes(gaussians: dict[str, Tensor], cameras: dict[str, Tensor], width: int, height: int) -> None:
    """Check shapes, dtypes and devices of what `rasterize` was given.

    Args:
        gaussians: means, quats, scales, opacities and features, each with or without a view dimension.
        cameras: camera_from_world `[b,4,4]` and intrinsics `[b,3,3]`.
        width: of the image, px.
        height: of the image, px.

    Raises:
        RenderError: something does not fit; nothing was computed.
    """
    if width < 1 or height < 1:
        raise RenderError(f"image size is {width} x {height} px; expected at least 1 x 1")
    views = cameras["camera_from_world"].shape[0]
    for name, side in (("camera_from_world", 4), ("intrinsics", 3)):
        if tuple(cameras[name].shape) != (views, side, side):
            raise RenderError(f"{name} has shape {list(cameras[name].shape)}; expected [{views}, {side}, {side}]")
    count = gaussians["means"].shape[-2] if gaussians["means"].ndim >= 2 else -1
    for name, pattern in _GAUSSIAN_SHAPES.items():
        shape = gaussians[name].shape
        shared = len(shape) == len(pattern)
        per_view = len(shape) == len(pattern) + 1 and shape[0] == views
        tail = shape[len(shape) - len(pattern) :]
        fits = all(
            want == "c" or got == (count if want == "g" else want) for got, want in zip(tail, pattern, strict=False)
        )
        if not (shared or per_view) or not fits:
            want = ", ".join(str(count) if p == "g" else str(p) for p in pattern)
            raise RenderError(
                f"{name} has shape {list(shape)}; expected [{want}], or [{views}, {want}] (one set per view)"
            )
    means = gaussians["means"]
    for name, tensor in {**gaussians, **cameras}.items():
        if tensor.dtype != means.dtype or tensor.device != means.device:
            raise RenderError(
                f"{name} is {tensor.dtype} on {tensor.device}, means are {means.dtype} on {means.device}; "
                "all tensors of one call must agree"
            )


def check_values(gaussians: dict[str, Tensor], cameras: dict[str, Tensor]) -> None:
    """Check that every number can be rendered: finite, opacities in 0..1, scales not negative, quats not zero.

    Raises:
        RenderError: names the tensor, the index of the first bad entry, its value and what was expected.
    """
    check_cameras(**cameras)
    for name, tensor in gaussians.items():
        _refuse_first(name, tensor, ~torch.isfinite(tensor), "a finite number")
    _refuse_first("scales", gaussians["scales"], gaussians["scales"] < 0, "at least 0 (linear, metres)")
    opacities = gaussians["opacities"]
    _refuse_first("opacities", opacities, (opacities < 0) | (opacities > 1), "0..1 (not logits)")
    length = gaussians["quats"].norm(dim=-1)
    _refuse_first(
        "the length of quats",
        length,
        (length < QUAT_LENGTHS[0]) | (length > QUAT_LENGTHS[1]),
        "any but zero",
    )


def check_cameras(camera_from_world: Tensor, intrinsics: Tensor) -> None:
    """Check that poses and intrinsics are finite and focal lengths positive.

    Raises:
        RenderError: names the tensor and the index of the first bad entry.
    """
    for name, tensor in (("camera_from_world", camera_from_world), ("intrinsics", intrinsics)):
        _refuse_first(name, tensor, ~torch.isfinite(tensor), "a finite number")
    focal = torch.diag_embed(intrinsics[:, [0, 1], [0, 1]] <= 0)
    bad = torch.nn.functional.pad(focal, (0, 1, 0, 1))
    _refuse_first("intrinsics", intrinsics, bad, "a positive focal length, px")


def _refuse_first(name: str, tensor: Tensor, bad: Tensor, expected: str) -> None:
    if not bad.any():
        return
    index = tuple(bad.nonzero()[0].tolist())
    total = int(bad.sum())
    raise RenderError(
        f"{name} at index {list(index)} is {tensor[index].item():g}; expected {expected} "
        f"({total} such {'entry' if total == 1 else 'entries'} of {bad.numel()})"
    )
