"""A video is cut where its camera was moved, and where it is long; each window has priors and a scene of its own."""

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import UInt8
from torch import Tensor

from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.priors.cache import open_cache
from lerobot_msdyn.priors.camera.path import CameraPath, camera_path
from lerobot_msdyn.priors.camera.stands import Stand, Stands, stands_along
from lerobot_msdyn.reconstruction.pooled_background import few
from lerobot_msdyn.reconstruction.steady import steadied


@dataclass(frozen=True)
class Window:
    """A part of a video."""

    start: int  # its first frame in the video
    view: View  # as recorded
    path: CameraPath | None = None  # from the camera's usual place to where it is at each frame; None: it keeps still

    def steady(self, max_width: int) -> View:
        """As a camera in its usual place would have recorded it, with at most `max_width` columns."""
        small = self.view.shrunk(max_width)
        return small if self.path is None else steadied(small, self.path)

    def few_frames(self, max_width: int) -> View:
        """The same of some evenly spread frames."""
        frames = torch.tensor(few(len(self.view)))
        path = None if self.path is None else self.path.part(frames)
        return Window(self.start, self.view.select(frames), path).steady(max_width)


def stands_of(view: View, recipe: Recipe) -> Stands:
    """Where the camera of a video stood.

    In one place where it is said to move, or where priors are for the whole video.
    """
    if recipe.needs_whole_videos or not view.camera.is_static:
        return Stands((Stand(0, len(view), 0.0),))
    return seen_stands(view.rgb, recipe.priors.cache)


def seen_stands(rgb: UInt8[Tensor, "t h w 3"], cache: str) -> Stands:
    """Where the camera of a video stood, by its pictures alone; its path is kept in the cache."""

    def compute() -> dict:
        path = camera_path(rgb)
        return {"affines": path.affines, "size": [path.width, path.height]}

    kept = open_cache(cache, rgb).get("path", "corners", {}, compute)
    return stands_along(CameraPath(kept["affines"], *map(int, kept["size"])), rgb)


def whole_stands(view: View, stands: Stands) -> list[Window]:
    """One window for each place in which the camera stood; where it moves, one as it was recorded."""
    if stands.moves:
        return [Window(0, view)]
    return [Window(stand.start, view.select(slice(stand.start, stand.end)), stand.path) for stand in stands.stands]


def windows(whole: Window, recipe: Recipe) -> list[Window]:
    """Parts of about equal length of a window; priors from a file are for all of it."""
    frames = len(whole.view)
    count = 1 if recipe.needs_whole_videos else -(-frames // recipe.fit.window_frames)
    bounds = [round(i * frames / count) for i in range(count + 1)]
    return [
        Window(
            whole.start + start,
            whole.view.select(slice(start, end)),
            None if whole.path is None else whole.path.part(slice(start, end)),
        )
        for start, end in itertools.pairwise(bounds)
    ]
