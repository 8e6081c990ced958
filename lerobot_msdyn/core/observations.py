"""What the priors hand to the reconstruction: depth, instances, point tracks and the camera of one video."""

from dataclasses import asdict, dataclass, field

from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.priors.hub import LocalModel

# Relative error of depth that cannot be seen in the video, by the provider of depth; others: OTHER_DEPTH_ERROR.
DEPTH_ERROR = {"recorded": 0.01, "stereo": 0.02, "plane": 0.10}
OTHER_DEPTH_ERROR = 0.05


@dataclass(frozen=True)
class Origin:
    """Which provider a prior comes from, and why that one."""

    provider: str
    why: str
    model: str = ""  # empty where nothing learned is involved
    revision: str = ""
    licence: str = ""

    @classmethod
    def learned(cls, provider: str, model: LocalModel, why: str) -> "Origin":
        """That of a learned model."""
        return cls(provider, why, model.name, model.revision, model.licence)

    @property
    def line(self) -> str:
        """For the log."""
        model = f" ({self.model}, revision {self.revision}, {self.licence})" if self.model else ""
        return f"{self.provider}{model}: {self.why}"

    def entry(self) -> dict[str, str]:
        """For files: what is known, by name."""
        return {name: value for name, value in asdict(self).items() if value}


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
    tracks: PointTracks
    metric: bool  # whether depth is in true metres (a sensor or a calibration) or only plausible
    provenance: dict[str, dict[str, str]] = field(default_factory=dict)  # prior -> provider, why, model, licence
    camera: CameraTrack | None = None  # the one to use from here on; None: that of the video

    @property
    def depth_error(self) -> float:
        """Relative error of depth that its provider is known to make."""
        return DEPTH_ERROR.get(self.provenance.get("depth", {}).get("provider", ""), OTHER_DEPTH_ERROR)
