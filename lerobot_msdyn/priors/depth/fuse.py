"""A network's depth before a fixed camera, put together with the ground that things stand on.

What stands still has one depth throughout, from frames of all episodes where there are several. It is aligned once, to
the ground; where the ground is known and not only assumed, what lies on it is put on it, and nothing is below. What
moves keeps the network's depth unless that puts it behind its own foot, as small networks do with thin upright arms
(benchmarks/notes/priors.md): then it stands where its foot does. The less the network agrees with a known ground, the
more counts what is told without it: of what stands up to a half, of what moves up to all.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.sampling import evenly, scaled_px
from lerobot_msdyn.priors.depth.align import MAX_FACTOR, scale_alone, scale_and_shift
from lerobot_msdyn.priors.depth.uprights import ON_GROUND

MOST_FRAMES = 60  # that what is empty is told by
# Quantile of inverse depth over frames that stands for what is empty: networks draw what is around a near thing towards
# it, and never away from it.
EMPTY = 0.25
MARGIN_PX = 4.0  # of 320: about what moves
SPECK_PX = 5.0  # of 320: what is smaller, and said to stand on the ground, does not
NEAR_GROUND = (0.02, 0.09)  # share of inverse depth by which depth may be off and mean the ground, least and most
SPREAD = 0.68  # quantile of the differences from the ground that stands for their standard deviation
SPREADS = 3.0  # times how far it usually is from the ground that it agrees with, between these
AGREES = 0.06  # the same, of those pixels that say how it is to be aligned
FARTHEST_GROUND = 0.3  # share of the largest inverse depth of the ground, below which it is no evidence
LEAST_GROUND = 0.15  # share of the pixels before that, that must agree
TRIALS, SAMPLES = 600, 4000  # alignments by two pixels each; pixels that judge them
TRUSTED = (0.03, 0.06)  # share of inverse depth by which a network is off the ground: it counts in full, and least
OTHERWISE = 0.5  # share of depth without the network in what stands, where the network counts least
BEHIND_FOOT = 1.15  # times as far as its foot: what moves is not there
BEYOND_WALL = 1.5  # times as far as the wall that is assumed behind the ground, a network may see


def fused(
    inverse: Float[Tensor, "t h w"],
    instances: UInt8[Tensor, "t h w"],
    ground: Float[Tensor, "h w"],
    standing: Float[Tensor, "t h w"],
    elsewhere: Float[Tensor, "m h w"] | None,
    *,
    shifted: bool,
    known: bool,
) -> Float[Tensor, "t h w"]:
    """z-depth (m) of every frame.

    Args:
        inverse: inverse depth by the network, up to a factor; not finite = unknown.
        instances: what moves.
        ground: z-depth (m) of the ground and what is taken for a wall behind it.
        standing: z-depth (m) without the network: what moves stands on the ground.
        elsewhere: the network's inverse depth of frames of all episodes of this camera.
        shifted: whether the network's inverse depth lacks a shift as well.
        known: whether the ground is known, and not only assumed.

    Raises:
        PriorError: the network's depth and the ground have nothing in common.
    """
    own = _still(inverse, instances)
    still = own if elsewhere is None else _empty(torch.cat((own[None], elsewhere)))
    aligned_to = still if elsewhere is None else _empty(elsewhere)  # the same for all episodes
    if known:
        scale, shift, near = _to_ground(aligned_to, ground, shifted)
    elif shifted:
        scale, shift = scale_and_shift(aligned_to[None], ground[None])
    else:
        scale, shift = 1 / scale_alone(aligned_to.reciprocal()[None], ground[None]), 0.0
    least = 1 / (MAX_FACTOR * float(ground.max()))
    depth = (scale * inverse.nan_to_num(nan=0.0) + shift).clamp(min=least).reciprocal()
    depth = torch.where(torch.isfinite(inverse), depth, 0.0)
    empty = (scale * still.nan_to_num(nan=0.0) + shift).clamp(min=least)
    moving = _not_behind_feet(depth, instances, standing)
    if known:
        farthest = torch.where(ground < ground.max(), ground, BEYOND_WALL * ground)
        distrust = _distrust(empty, ground, torch.where(instances == 0, standing, torch.inf).amin(0))
        empty, moving = _above(empty, farthest.reciprocal(), near), torch.minimum(moving, farthest)
        told = torch.where(standing < ON_GROUND * ground, standing.reciprocal(), empty)
        empty = torch.lerp(empty, told, OTHERWISE * distrust)
        both = torch.lerp(moving.reciprocal(), standing.reciprocal(), distrust).reciprocal()
        moving = torch.where(moving > 0, both, 0.0)
    return torch.where(instances > 0, moving, empty.reciprocal())


def _still(inverse: Float[Tensor, "t h w"], instances: UInt8[Tensor, "t h w"]) -> Float[Tensor, "h w"]:
    """Of frames in which nothing moves at a pixel or near it; where there are none, of all."""
    some = evenly(len(inverse), MOST_FRAMES)
    window = np.ones((2 * round(scaled_px(MARGIN_PX, inverse.shape[2])) + 1,) * 2, np.uint8)
    near = np.stack([cv2.dilate((mask > 0).astype(np.uint8), window) for mask in instances[some].numpy()])
    values = inverse[some]
    still = _empty(torch.where(torch.from_numpy(near > 0), torch.nan, values))
    return torch.where(torch.isfinite(still), still, _empty(values))


def _empty(values: Float[Tensor, "m h w"]) -> Float[Tensor, "h w"]:
    """What several frames say of the empty scene; NaN where none says anything."""
    return torch.where(torch.isfinite(values), values, torch.nan).nanquantile(EMPTY, dim=0)


def _to_ground(still: Float[Tensor, "h w"], ground: Float[Tensor, "h w"], shifted: bool) -> tuple[float, float, float]:
    """Scale and shift of inverse depth at which most pixels lie on the ground, and by what share these may be off.

    What stands on it is no part of it.
    """
    target = ground.reciprocal()
    usable = torch.isfinite(still) & (target > FARTHEST_GROUND * target.max()) & (still > 0)
    x, y = still[usable].double(), target[usable].double()
    chosen = evenly(len(x), SAMPLES)
    x, y = x[chosen], y[chosen]
    if len(x) < 2:
        raise PriorError("the network's depth is unknown where the ground is seen")
    pairs = torch.randint(len(x), (2, TRIALS), generator=torch.Generator().manual_seed(0))
    (x0, x1), (y0, y1) = x[pairs], y[pairs]
    if shifted:
        apart = (x0 - x1).abs() > 1e-6 * x.abs().max()
        scales = torch.where(apart, (y0 - y1) / torch.where(apart, x0 - x1, 1.0), -1.0)
        shifts = y0 - scales * x0
    else:
        scales, shifts = y0 / x0, torch.zeros_like(y0)
    agrees = ((scales[:, None] * x + shifts[:, None]) / y - 1).abs() < AGREES
    count = torch.where(scales > 0, agrees.sum(1), 0)
    best = int(count.argmax())
    if count[best] < LEAST_GROUND * len(x):
        raise PriorError(
            f"the network's depth agrees with the ground in {100 * int(count[best]) / len(x):.0f} % of its pixels; "
            f"expected {100 * LEAST_GROUND:.0f} %, see docs/priors.md"
        )
    inside = agrees[best]
    columns = (x[inside], torch.ones_like(x[inside])) if shifted else (x[inside],)
    design = torch.stack(columns, dim=1) / y[inside][:, None]
    solution = torch.linalg.lstsq(design, torch.ones_like(design[:, :1])).solution[:, 0].tolist()
    scale, shift = solution[0], solution[1] if shifted else 0.0
    spread = float(((scale * x[inside] + shift) / y[inside] - 1).abs().quantile(SPREAD))
    return scale, shift, min(max(SPREADS * spread, NEAR_GROUND[0]), NEAR_GROUND[1])


def _above(inverse: Float[Tensor, "h w"], ground: Float[Tensor, "h w"], near: float) -> Float[Tensor, "h w"]:
    """Inverse depth with that of the ground where it is more by no more than a share `near`, or less."""
    stands = (inverse > (1 + near) * ground).numpy().astype(np.uint8)
    window = np.ones((max(1, round(scaled_px(SPECK_PX, inverse.shape[1]))),) * 2, np.uint8)
    for operation in (cv2.MORPH_OPEN, cv2.MORPH_CLOSE):
        stands = cv2.morphologyEx(stands, operation, window)
    return torch.where(torch.from_numpy(stands > 0), torch.maximum(inverse, ground), ground)


def _distrust(inverse: Float[Tensor, "h w"], ground: Float[Tensor, "h w"], still: Float[Tensor, "h w"]) -> float:
    """How little a network counts, 0..1, by how far off it is where the ground is seen.

    Args:
        inverse: inverse depth of what is empty, by the network, aligned.
        ground: z-depth (m).
        still: z-depth (m) of what keeps still, without the network; infinite where something moves throughout.
    """
    lies = (still >= ON_GROUND * ground) & torch.isfinite(still) & (ground < ground.max())
    if not bool(lies.any()):
        return 0.0
    off = float((inverse * ground - 1).abs()[lies].quantile(SPREAD))
    return min(max((off - TRUSTED[0]) / (TRUSTED[1] - TRUSTED[0]), 0.0), 1.0)


def _not_behind_feet(
    depth: Float[Tensor, "t h w"], instances: UInt8[Tensor, "t h w"], standing: Float[Tensor, "t h w"]
) -> Float[Tensor, "t h w"]:
    """Depth of what moves; of an instance that is usually behind its foot, its foot's."""
    for instance in range(1, int(instances.max()) + 1):
        its = (instances == instance) & (depth > 0)
        if bool(its.any()) and float((depth[its] / standing[its]).median()) > BEHIND_FOOT:
            depth = torch.where(instances == instance, standing, depth)
    return depth
