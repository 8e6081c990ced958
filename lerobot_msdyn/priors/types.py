"""What the priors hand to the reconstruction: depth, instances and point tracks of one camera's video."""

from dataclasses import dataclass, field

from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor


@dataclass(frozen=True)
class PointTracks:
    """Points followed through a video. A point's position means something only where it is visible."""

    xy: Float[Tensor, "n t 2"]  # px, pixel centres at half-integers
    visible: Bool[Tensor, "n t"]
    confidence: Float[Tensor, "n t"]  # 0..1
    instance: Int[Tensor, " n"]  # instance id of the point (never 0, the background)

    def __len__(self) -> int:
        return self.xy.shape[0]


@dataclass(frozen=True)
class Priors:
    """Everything known about a video before any Gaussian is fitted."""

    depth: Float[Tensor, "t h w"]  # m, z-depth; 0 = unknown
    instances: UInt8[Tensor, "t h w"]  # 0 = static background, 1.. = moving instances
    empty: UInt8[Tensor, "h w 3"]  # colours of the scene without what moves
    tracks: PointTracks
    metric: bool  # whether depth is in true metres (a sensor or a calibration) or only plausible
    provenance: dict[str, str] = field(default_factory=dict)  # prior -> one line: which provider, and why
