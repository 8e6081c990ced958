"""In place of `augment_episode`: new episodes whose pictures are made up, quickly and always the same."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.dataset.checks import picture_size
from lerobot_msdyn.dataset.provenance import SOURCE_VARIANT, Provenance
from lerobot_msdyn.dataset.write import NewEpisode, OutputDataset
from lerobot_msdyn.reconstruction.account import Account
from lerobot_msdyn.scene.sources import MovingPixels

UNREADABLE: set[int] = set()  # episodes that fail


def made_up(
    source: LeRobotDatasetMetadata, index: int, cameras: list[str], recipe: Recipe, output: OutputDataset, *_: Any
) -> list[NewEpisode]:
    """The recorded episode, and a new one of noise for each variant."""
    if index in UNREADABLE:
        raise EpisodeError(f"{source.repo_id} episode {index}: cannot be read")
    new = [NewEpisode(index, Provenance(source.repo_id, index, SOURCE_VARIANT, recipe.seed))]
    account = Account(MovingPixels(90, 5, 5, 0), 0.01, 0.02, held_out=False).entry()
    for variant in range(recipe.variants if cameras else 0):
        provenance = Provenance(
            source.repo_id,
            index,
            variant,
            recipe.seed,
            {key: {"azimuth_deg": float(index)} for key in cameras},
            {key: {"depth": {"provider": "made up", "why": "a test"}} for key in cameras},
            {key: {"K": np.eye(3).tolist(), "camera_from_source": np.eye(4).tolist()} for key in cameras},
            {"views": {key: {"distance_m": 1.0, "what_moves": account} for key in cameras}, "rejected": []},
        )
        staged = output.stage(index, variant, _frames(source, index, variant, cameras), provenance)
        new.append(NewEpisode(index, provenance, staged.pictures, seconds={"judging": 0.0}))
    return new


def _frames(
    source: LeRobotDatasetMetadata, index: int, variant: int, cameras: list[str]
) -> Iterator[dict[str, np.ndarray]]:
    for frame in range(int(source.episodes[index]["length"])):
        rng = np.random.default_rng([index, variant, frame])
        yield {key: rng.integers(0, 256, (*picture_size(source.features[key])[:2], 3), np.uint8) for key in cameras}
