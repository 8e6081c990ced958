"""What episodes share is fitted once and kept on disk, and long videos are cut into windows that share it too."""

import contextlib
import dataclasses
import itertools
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from lerobot.datasets import LeRobotDatasetMetadata
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import EpisodeError, PriorError
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.dataset.read import View, read_episode, shrink
from lerobot_msdyn.priors import PointTracks, Priors, estimate_masks
from lerobot_msdyn.priors.cache import code_digest, digest_of, open_cache
from lerobot_msdyn.reconstruct.fit import fit
from lerobot_msdyn.reconstruct.initialise import initialise
from lerobot_msdyn.reconstruct.pooled_background import (
    MAX_EPISODES,
    MovingIn,
    SharedBackground,
    as_arrays,
    few,
    few_frames,
    from_arrays,
    pooled,
    same_places,
)
from lerobot_msdyn.render.cpu.threads import torch_on_one_thread
from lerobot_msdyn.render.devices import chosen_device
from lerobot_msdyn.views.perturbation import look_at_distance

logger = logging.getLogger(__name__)

NEAR = 0.01  # of the look-at distance, within which nothing is drawn: depth may be of any scale

Backgrounds = Mapping[str, Sequence[SharedBackground]]  # by camera


@dataclass(frozen=True)
class MaskTask:
    """What moves in some frames of one camera's video: what is asked of `moving_in_episode`."""

    episode: int
    key: str
    recipe: Recipe
    frames: UInt8[ndarray, "m h w 3"]  # of all episodes that are looked at


Run = Callable[[Callable[[LeRobotDatasetMetadata, MaskTask], Any], list[MaskTask]], Iterable[Any]]


def shared_backgrounds(
    source: LeRobotDatasetMetadata, cameras: list[str], recipe: Recipe, run: Run | None = None
) -> Backgrounds:
    """Per camera, what some of its episodes show together, fitted once; one for every place in which it stood.

    Episodes that cannot be read are left out here, and reported when it is their turn. `run` calls a function with the
    source and each of some tasks, in this process or in others; by default in this one.
    """
    episodes = background_episodes(source, recipe)
    if not episodes:
        return {}
    views: dict[str, dict[int, View]] = {key: {} for key in cameras}  # by episode
    for index in episodes:
        with contextlib.suppress(EpisodeError):
            episode = read_episode(source, index, cameras, recipe.camera, recorded_depth=recipe.priors.depth != "plane")
            for key, view in episode.views.items():
                views[key][index] = shrink(few_frames(view), recipe.fit.max_width)
    found: dict[str, list[SharedBackground]] = {}
    for key, some in views.items():
        indices = list(some)

        def moving(
            numbers: Sequence[int], frames: Tensor, key: str = key, indices: list[int] = indices
        ) -> Iterable[Tensor]:
            tasks = [MaskTask(indices[number], key, recipe, frames.numpy()) for number in numbers]
            found = (
                (moving_in_episode(source, task) for task in tasks) if run is None else run(moving_in_episode, tasks)
            )
            return map(torch.from_numpy, found)

        with torch_on_one_thread():
            found[key] = share(list(some.values()), moving, recipe)
    return found


def moving_in_episode(source: LeRobotDatasetMetadata, task: MaskTask) -> UInt8[ndarray, "t h w"]:
    """What moves in those frames of an episode that `few_frames` takes; everything, where no masks can be had."""
    view = read_episode(source, task.episode, [task.key], task.recipe.camera, recorded_depth=False).views[task.key]
    try:
        with torch_on_one_thread():
            return moving_in_few(view, task.recipe, torch.from_numpy(task.frames), task.episode, task.key).numpy()
    except PriorError as error:  # a file of masks may be there for some episodes alone
        logger.warning("shared background: episode %d is left out: %s", task.episode, error)
        return np.ones((len(few(len(view.rgb))), *task.frames.shape[1:3]), np.uint8)


def background_episodes(source: LeRobotDatasetMetadata, recipe: Recipe) -> list[int]:
    """The episodes that `shared_backgrounds` looks at."""
    if not recipe.scene.shared_background or source.total_episodes < 2:
        return []
    return looked_at(source.total_episodes)


def looked_at(episodes: int) -> list[int]:
    """Indices of those of a dataset's two or more episodes that are looked at."""
    count = min(MAX_EPISODES, episodes)
    return sorted({round(i * (episodes - 1) / (count - 1)) for i in range(count)})


def share(views: list[View], moving: MovingIn, recipe: Recipe) -> list[SharedBackground]:
    """A fitted background per place in which a camera stood, from some frames of several videos; kept on disk."""
    return [_kept([views[i] for i in group], group, moving, recipe) for group in same_places(views)]


def _kept(views: list[View], numbers: list[int], moving: MovingIn, recipe: Recipe) -> SharedBackground:
    """That of videos from one place: an earlier run's of the same frames and settings, else a new one."""
    frames, camera = torch.cat([view.rgb for view in views]), views[0].camera.select([0])
    settings: dict[str, Any] = {name: dataclasses.asdict(getattr(recipe, name)) for name in ("camera", "scene", "fit")}
    settings |= {
        "priors": dataclasses.asdict(replace(recipe.priors, cache="")),
        "seed": recipe.seed,
        "depth": [
            None if view.depth is None else digest_of(view.depth.contiguous().view(torch.uint8)) for view in views
        ],
        "camera in use": [camera.intrinsics.tolist(), camera.world_from_camera.tolist()],
        "package": code_digest(Path(__file__).parents[1]),
    }

    def compute() -> dict:
        return as_arrays(_fitted(pooled(views, numbers, moving), recipe))

    cache = open_cache(recipe.priors.cache, frames)
    return from_arrays(cache.get("background", "shared", settings, compute), camera, frames)


def moving_in_few(view: View, recipe: Recipe, elsewhere: Tensor, episode: int | None, key: str | None) -> Tensor:
    """What moves in the frames that `few_frames` takes; the masks of the whole video, which its fit finds cached."""
    masks = [
        estimate_masks(
            shrink(window, recipe.fit.max_width),
            recipe.priors,
            recipe.camera,
            elsewhere=elsewhere,
            episode=episode,
            key=key,
            device=recipe.device,
        )
        for _, window in windows(view, recipe)
    ]
    return torch.cat(masks)[few(len(view.rgb))]


def _fitted(background: SharedBackground, recipe: Recipe) -> SharedBackground:
    """A shared background with a static set that was fitted to its picture; without depth there is none."""
    empty, camera = background.empty, background.camera
    if not bool((empty.depth > 0).any()):
        return background
    nothing = torch.zeros(1, *empty.seen.shape, dtype=torch.uint8)
    priors = Priors(empty.depth[None], nothing, _no_tracks(), metric=True)
    view = View(empty.rgb[None], camera)
    scene = initialise(view, priors, replace(recipe.scene, moving_gaussians=0), recipe.motion, empty)
    config = replace(recipe.fit, steps=recipe.fit.steps // 2, shadows=False, held_out_frames=0)
    try:
        distance = look_at_distance(empty.depth)
        scene = replace(scene, near=NEAR * distance)
        scene = to_device(scene, chosen_device(recipe.device))
        result = fit(scene, view, priors, config, empty=empty.rgb, distance=distance, seed=recipe.seed)
    except EpisodeError as error:
        logger.warning("shared background: %s; every episode fits its own", error)
        return background
    return replace(background, static=to_device(result.scene.static, "cpu"))


def _no_tracks() -> PointTracks:
    none = torch.zeros(0, 1)
    return PointTracks(torch.zeros(0, 1, 2), none.bool(), none, torch.zeros(0, dtype=torch.long))


def windows(view: View, recipe: Recipe) -> list[tuple[int, View]]:
    """First frames and parts of a video, of about equal length; priors from a file are for the whole video."""
    frames = len(view.rgb)
    count = 1 if recipe.needs_whole_videos else -(-frames // recipe.fit.window_frames)
    bounds = [round(i * frames / count) for i in range(count + 1)]
    parts = []
    for start, end in itertools.pairwise(bounds):
        depth = None if view.depth is None else view.depth[start:end]
        parts.append((start, View(view.rgb[start:end], view.camera.select(slice(start, end)), depth, view.depth_range)))
    return parts
