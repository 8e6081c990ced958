"""A recorded episode with what is wrong with its pictures, and with stand-ins for frames that cannot be used."""

import contextlib
from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import UInt8
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.dataset.read import Episode, read_colour, read_episode
from lerobot_msdyn.dataset.rows import read_rows
from lerobot_msdyn.priors.defects import Defects, find_defects, repaired

MOST_UNUSABLE = 0.5  # share of the frames; where more show nothing, there is nothing to reconstruct


def read_recorded(
    source: LeRobotDatasetMetadata,
    index: int,
    cameras: Sequence[str],
    recipe: Recipe,
    *,
    recorded_depth: bool | None = None,
) -> tuple[Episode, dict[str, Defects]]:
    """One episode for the job, and the defects of each camera's pictures.

    Raises:
        EpisodeError: a file of the episode is absent or damaged, or most of a camera's frames are blank.
        PriorError: the calibration file cannot be used.
    """
    depth = recipe.priors.reads_recorded_depth if recorded_depth is None else recorded_depth
    episode = read_episode(source, index, list(cameras), recipe.camera, recorded_depth=depth)
    defects = {
        key: find_defects(view.rgb, episode.state, last_picture(source, index - 1, key))
        for key, view in episode.views.items()
    }
    for key, found in defects.items():
        if len(found.unusable) > MOST_UNUSABLE * found.frames:
            raise EpisodeError(
                f"{source.repo_id} episode {index}, {key}: {len(found.unusable)} of {found.frames} frames are blank; "
                "leave the episode or the camera out (--episodes, --cameras)"
            )
    return replace(episode, views={key: repaired(view, defects[key]) for key, view in episode.views.items()}), defects


def last_picture(source: LeRobotDatasetMetadata, index: int, key: str) -> UInt8[Tensor, "1 h w 3"] | None:
    """The last picture of an episode; none where there is no such episode or it cannot be read."""
    if index >= 0:
        with contextlib.suppress(EpisodeError):
            rows = read_rows(source, index)
            return read_colour(source, index, key, rows, [len(rows) - 1])
    return None
