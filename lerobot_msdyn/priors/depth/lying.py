"""Things that lie on the ground rather than stand upright on it, told by their rigidity.

Of depth that is assumed, an instance is a card that stands on its foot: right for a bottle, wrong for a keyboard or a
book that is pushed about. Between the card and the ground lies a family of planes through the foot; that one is taken
in which neighbouring points of the instance keep their distances best while it moves.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import nearest_pixel
from lerobot_msdyn.core.observations import PointTracks
from lerobot_msdyn.core.sampling import evenly, scaled_px
from lerobot_msdyn.priors.registry import Depth, Masks

UPRIGHT = (0.0, 0.25, 0.5, 0.75)  # shares of the way from the ground to the depth so far, in inverse depth
BETTER = 0.9  # of the spread of distances so far: as much a plane must lower it to
FRAMES = 24  # that are compared
NEIGHBOURS = 6  # of each point
APART_PX = (5.0, 40.0)  # of 320: nearest and farthest neighbours
LEAST_PAIRS = 100
LEAST_FRAMES = 4  # in which both points of a pair are seen


def with_lying(depth: Depth, instances: Masks, tracks: PointTracks, camera: CameraTrack) -> Depth:
    """Depth in which instances lie as flat as their motion says.

    Args:
        depth: with the ground that it stands on; without one it stays as it is.
        instances: what moves.
        tracks: points on it.
        camera: a fixed one.
    """
    if depth.ground is None or not len(tracks):
        return depth
    z, ground = depth.z, depth.ground
    for instance in tracks.instance.unique().tolist():
        share = _upright(z, ground, tracks, tracks.instance == instance, camera)
        if share < 1:
            its = (instances == instance) & (z > 0)
            z = torch.where(its, _between(z, ground, share), z)
    return replace(depth, z=z)


def _between(z: Float[Tensor, "*any"], ground: Float[Tensor, "*#any"], share: float) -> Float[Tensor, "*any"]:
    """Depth (m) of a plane through the foot."""
    return 1 / (share / z.clamp(min=1e-6) + (1 - share) / ground)


def _upright(
    z: Float[Tensor, "t h w"],
    ground: Float[Tensor, "h w"],
    tracks: PointTracks,
    rows: Bool[Tensor, " n"],
    camera: CameraTrack,
) -> float:
    """The share of `UPRIGHT` at which an instance is most rigid; 1 where none is clearly better."""
    frames = evenly(len(z), FRAMES)
    xy, seen = tracks.xy[rows][:, frames], tracks.visible[rows][:, frames]
    first, second = _pairs(xy, seen, camera.width)
    if len(first) < LEAST_PAIRS:
        return 1.0
    pixel = nearest_pixel(torch.where(seen[..., None], xy, 0.0), camera.width, camera.height)
    own, under = z[(frames, *pixel)], ground[pixel]
    seen = seen & (own > 0)
    rays = torch.cat((xy, torch.ones_like(xy[..., :1])), -1) @ torch.linalg.inv(camera.intrinsics[0]).T
    both = seen[first] & seen[second]
    enough = both.sum(1) >= LEAST_FRAMES
    first, second, both = first[enough], second[enough], both[enough]
    if len(first) < LEAST_PAIRS:
        return 1.0

    def spread(share: float) -> float:
        xyz = rays * _between(own, under, share)[..., None]
        length = (xyz[first] - xyz[second]).norm(dim=-1).clamp(min=1e-6).log()
        mean = (length * both).sum(1, keepdim=True) / both.sum(1, keepdim=True)
        return float((((length - mean).square() * both).sum(1) / both.sum(1)).sqrt().median())

    spreads = {share: spread(share) for share in UPRIGHT}
    best = min(spreads, key=lambda share: spreads[share])
    return best if spreads[best] < BETTER * spread(1.0) else 1.0


def _pairs(
    xy: Float[Tensor, "n t 2"], seen: Bool[Tensor, "n t"], width: int
) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """Neighbouring points, where most points are seen at once."""
    frame = int(seen.sum(0).argmax())
    there = seen[:, frame].nonzero()[:, 0]
    if len(there) < 2:
        return there[:0], there[:0]
    nearest, farthest = (scaled_px(px, width) for px in APART_PX)
    distance = torch.cdist(xy[there, frame], xy[there, frame])
    distance[(distance < nearest) | (distance > farthest)] = torch.inf
    least, index = distance.topk(min(NEIGHBOURS, len(there)), largest=False)
    row, column = least.isfinite().nonzero(as_tuple=True)
    return there[row], there[index[row, column]]
