"""Long videos are cut into windows, each with priors and a scene of its own."""

import itertools

from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.observations import View


def windows(view: View, recipe: Recipe) -> list[tuple[int, View]]:
    """First frames and parts of a video, of about equal length; priors from a file are for the whole video."""
    frames = len(view.rgb)
    count = 1 if recipe.needs_whole_videos else -(-frames // recipe.fit.window_frames)
    bounds = [round(i * frames / count) for i in range(count + 1)]
    return [(start, view.select(slice(start, end))) for start, end in itertools.pairwise(bounds)]
