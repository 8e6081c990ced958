"""What `MixedViews` and the plug-in of `lerobot-train` can be told."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_msdyn.core.fields import INFINITY, MAX_SEED, between


@dataclass
class MixedViewsConfig:
    """`lerobot_msdyn.training`: which samples are seen from elsewhere while a policy is trained (docs/training.md)."""

    # Output of `augment --save_scenes true`, a folder or a name.
    scenes: Path = Path()
    # Share of the samples that are seen from elsewhere.
    probability: float = between(0.5, 0, 1)
    # A recipe, by file or name, whose perturbation is used; default: the one of the run that saved the scenes.
    perturbation: str | None = None
    # Seed of every random choice; together with the epoch and the sample's index it fixes the result.
    seed: int = between(0, 0, MAX_SEED)
    # Memory for the scenes that are kept loaded, in MB, in each data loading worker.
    memory_mb: float = between(1024.0, 0, INFINITY)
