"""Depth of unknown scale, made to agree with a reference: once per clip, so that a fixed camera's scene keeps still."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.core.errors import PriorError

_SAMPLES = 20_000  # pixels of a clip that an alignment looks at
_STEPS = 20
_MIN_PIXELS = 100
MAX_FACTOR = 2.0  # aligned depth is at most so many times the reference's largest


def align_disparity(
    disparity: Float[Tensor, "t h w"],
    reference: Float[Tensor, "t h w"],
    usable: Bool[Tensor, "t h w"] | None = None,
) -> Float[Tensor, "t h w"]:
    """Depth (m) of relative inverse depth, by one robust scale and shift per clip against a reference depth (m).

    Depth is bounded by twice the reference's largest, which also takes care of inverse depths that come out negative.

    Raises:
        PriorError: too few pixels are known in both, or the two disagree so much that the scale is not positive.
    """
    scale, shift = scale_and_shift(disparity, reference, usable)
    inverse = (scale * disparity + shift).clamp(min=1 / (MAX_FACTOR * float(reference.max())))
    return torch.where(torch.isfinite(disparity), inverse.reciprocal(), 0.0)


def scale_and_shift(
    disparity: Float[Tensor, "t h w"],
    reference: Float[Tensor, "t h w"],
    usable: Bool[Tensor, "t h w"] | None = None,
) -> tuple[float, float]:
    """Those of relative inverse depth that bring it closest to a reference depth (m).

    Least absolute differences of inverse depth, by iterated reweighting, over the pixels where the reference is known
    (and `usable`).

    Raises:
        PriorError: too few pixels are known in both, or the two disagree so much that the scale is not positive.
    """
    y, x = _samples(reference, disparity, usable)
    y = y.reciprocal()
    design = torch.stack((x, torch.ones_like(x)), dim=1)
    weights = torch.ones_like(x)
    for _ in range(_STEPS):
        root = weights.sqrt()[:, None]
        scale, shift = torch.linalg.lstsq(design * root, y[:, None] * root).solution[:, 0].tolist()
        weights = (design @ torch.tensor([scale, shift], dtype=x.dtype) - y).abs().clamp(min=1e-4).reciprocal()
    if scale <= 0:
        raise PriorError(
            "relative depth contradicts the depth that it is aligned to (its nearest parts are the farthest there); "
            "affine_disparity is larger where things are nearer, see docs/priors.md"
        )
    return scale, shift


def align_scale(
    depth: Float[Tensor, "t h w"],
    reference: Float[Tensor, "t h w"],
    usable: Bool[Tensor, "t h w"] | None = None,
) -> Float[Tensor, "t h w"]:
    """Depth (m) of depth that lacks only its scale, by the median ratio to a reference depth (m); 0 = unknown.

    Raises:
        PriorError: too few pixels are known in both.
    """
    return torch.where(torch.isfinite(depth), depth, 0.0) * scale_alone(depth, reference, usable)


def scale_alone(
    depth: Float[Tensor, "t h w"],
    reference: Float[Tensor, "t h w"],
    usable: Bool[Tensor, "t h w"] | None = None,
) -> float:
    """The median ratio of a reference depth (m) to depth that lacks only its scale (0 = unknown).

    Raises:
        PriorError: too few pixels are known in both.
    """
    known = torch.where(torch.isfinite(depth), depth, 0.0)
    y, x = _samples(reference, known, known > 0 if usable is None else usable & (known > 0))
    return float((y / x).median())


def _samples(
    reference: Float[Tensor, "t h w"], values: Float[Tensor, "t h w"], usable: Bool[Tensor, "t h w"] | None
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Pairs of reference depth (m) and value, evenly taken from where both are known."""
    both = (reference > 0) & torch.isfinite(values)
    if usable is not None:
        both &= usable
    y, x = reference[both].double(), values[both].double()
    if len(y) < _MIN_PIXELS:
        raise PriorError(f"relative depth can be aligned at {len(y)} pixels only; expected {_MIN_PIXELS} or more")
    stride = max(1, len(y) // _SAMPLES)
    return y[::stride], x[::stride]
