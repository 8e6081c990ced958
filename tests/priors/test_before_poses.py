"""What moves before a camera that moves, where poses and depth are known; and frames fused without it."""

from dataclasses import replace

import torch
from walking import walk

from lerobot_msdyn.core.config import CameraConfig, PriorsConfig
from lerobot_msdyn.priors import estimate_priors
from lerobot_msdyn.priors.masks.moving import moving_instances, temporal_median


def iou(found: torch.Tensor, true: torch.Tensor) -> float:
    return float(((found > 0) & (true > 0)).sum() / ((found > 0) | (true > 0)).sum())


def test_parallax_does_not_move() -> None:
    _, view, priors = walk()
    config = PriorsConfig(cache="off", tracks="flow", masks="change")
    found = estimate_priors(replace(view, depth=priors.depth), config, CameraConfig())
    without = moving_instances(view.rgb, *temporal_median(view.rgb))
    assert iou(found.instances, priors.instances) > max(0.4, iou(without, priors.instances) + 0.1)
    assert "by poses and depth" in found.provenance["masks"]["why"]
    still = (priors.instances == 0) & (found.instances > 0)
    assert still.float().mean() < 0.05
