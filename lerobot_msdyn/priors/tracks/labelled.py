"""Which moving instance each of some point tracks belongs to."""

import torch
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.observations import PointTracks


def on_instances(
    xy: Float32[ndarray, "n t 2"],
    visible: Bool[ndarray, "n t"],
    confidence: Float32[ndarray, "n t"] | None,
    instances: UInt8[Tensor, "t h w"],
) -> PointTracks:
    """The tracks (px) that lie on an instance for most of the time that they are seen."""
    frames, height, width = instances.shape
    at = torch.from_numpy(xy)
    seen = torch.from_numpy(visible) & ((at >= 0) & (at < torch.tensor([width, height]))).all(-1)
    column, row = at[..., 0].long().clamp(0, width - 1), at[..., 1].long().clamp(0, height - 1)
    under = torch.where(seen, instances[torch.arange(frames), row, column].long(), -1)
    votes = torch.stack([(under == i).sum(1) for i in range(int(instances.max()) + 1)], dim=1)
    instance = votes.argmax(1)
    kept = (instance > 0) & seen.any(1)
    sure = torch.ones(seen.shape) if confidence is None else torch.from_numpy(confidence).clamp(0, 1)
    return PointTracks(at[kept], seen[kept], torch.where(seen, sure, 0.0)[kept], instance[kept])
