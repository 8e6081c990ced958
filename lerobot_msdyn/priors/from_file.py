"""Providers that read an exchange file (docs/priors.md)."""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.geometry import invert_se3
from lerobot_msdyn.core.observations import PointTracks
from lerobot_msdyn.priors.depth.metres import in_metres
from lerobot_msdyn.priors.registry import (
    CameraProvider,
    Depth,
    DepthProvider,
    Estimate,
    MaskProvider,
    Masks,
    TrackProvider,
)
from lerobot_msdyn.priors.request import Request
from lerobot_msdyn.priors.tracks.labelled import on_instances


@dataclass(frozen=True)
class MaskFile(MaskProvider):
    """The array `masks`."""

    pattern: str

    def estimate(self, request: Request) -> Estimate[Masks]:
        """As they are."""
        content = request.exchange(self.pattern)
        if content.masks is None:
            raise PriorError(f"{self.setting}: {self.pattern} has no array `masks`; see docs/priors.md")
        return Estimate(torch.from_numpy(content.masks), model=content.model(self.prior))


@dataclass(frozen=True)
class CameraFile(CameraProvider):
    """The arrays `K` and `w2c`, or one of them."""

    known_before: ClassVar[bool] = True
    pattern: str

    def estimate(self, request: Request, instances: Masks) -> Estimate[CameraTrack]:
        """What the file lacks is that of the calibration, else assumed."""
        content = request.exchange(self.pattern)
        if content.K is None and content.w2c is None:
            raise PriorError(f"{self.setting}: {self.pattern} has neither K nor w2c; see docs/priors.md")
        camera = replace(request.view.camera, origin="exchange")
        if content.K is not None:
            camera = replace(camera, intrinsics=torch.from_numpy(content.K).contiguous())
        if content.w2c is not None:
            pose = invert_se3(torch.from_numpy(content.w2c).double()).float()
            camera = replace(camera, world_from_camera=pose, world=content.world)
        return Estimate(camera, model=content.model(self.prior))


@dataclass(frozen=True)
class DepthFile(DepthProvider):
    """The array `depth`, of the kind that the file states."""

    pattern: str

    def estimate(self, request: Request, instances: Masks) -> Estimate[Depth]:
        """Metric depth is taken at its word, unless a ground is known; other depth is aligned."""
        content = request.exchange(self.pattern)
        if content.depth is None:
            raise PriorError(f"{self.setting}: {self.pattern} has no array `depth`; see docs/priors.md")
        values = torch.from_numpy(content.depth)
        estimate = in_metres(request, instances, values, content.depth_kind, trusted=True)
        return replace(estimate, how=f"{content.depth_kind}; {estimate.how}", model=content.model(self.prior))


@dataclass(frozen=True)
class TrackFile(TrackProvider):
    """The arrays `tracks`, `vis` and `conf`."""

    pattern: str

    def estimate(self, request: Request, instances: Masks) -> Estimate[PointTracks]:
        """Those that lie on a moving instance."""
        content = request.exchange(self.pattern)
        if content.tracks is None or content.vis is None:
            raise PriorError(f"{self.setting}: {self.pattern} has no array `tracks`; see docs/priors.md")
        tracks = on_instances(content.tracks, content.vis, content.conf, instances)
        return Estimate(tracks, model=content.model(self.prior))
