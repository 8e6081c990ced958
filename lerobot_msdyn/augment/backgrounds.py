"""What several episodes of a dataset show together of each camera's background, before any of them is worked on."""

import contextlib
import functools
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from lerobot.datasets import LeRobotDatasetMetadata
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.augment.recorded import read_recorded
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import EpisodeError, PriorError
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.dataset.select import colour_cameras
from lerobot_msdyn.reconstruction.pooled_background import MAX_EPISODES, SharedBackground, few
from lerobot_msdyn.reconstruction.share_background import moving_in_few, share_backgrounds, shown_by
from lerobot_msdyn.reconstruction.shown_elsewhere import Shown
from lerobot_msdyn.reconstruction.windows import stands_of, whole_stands
from lerobot_msdyn.render.cpu.threads import in_threads, torch_on_one_thread

logger = logging.getLogger(__name__)

Backgrounds = Mapping[str, Sequence[SharedBackground | Shown]]  # by camera


@dataclass(frozen=True)
class MaskTask:
    """What moves in some frames of one camera's video: what is asked of `moving_in_episode`."""

    episode: int
    key: str
    recipe: Recipe
    stand: int  # number of the stretch in which the camera stood in one place
    frames: UInt8[ndarray, "m h w 3"]  # of all that are looked at


@dataclass(frozen=True)
class ShownTask:
    """What an episode shows of what stands still, where a camera moves: what is asked of `shown_in_episode`."""

    episode: int
    key: str
    recipe: Recipe


Run = Callable[[Callable[[LeRobotDatasetMetadata, Any], Any], list[Any]], Iterable[Any]]

READING = 0.2  # share of the time that reading takes
WORTH = 0.2  # of an episode's whole work, that looking at one of the background's takes
WORTH_SHOWN = 0.5  # the same where a camera moves


def seen_together(
    source: LeRobotDatasetMetadata,
    cameras: list[str],
    recipe: Recipe,
    run: Run | None = None,
    say: Callable[[str, float], object] = lambda what, share: None,
) -> Backgrounds:
    """What each episode shows where a camera moves and poses can be compared; `shared_backgrounds` of the others.

    Arguments as for `shared_backgrounds`.
    """
    known = [key for key in cameras if recipe.camera.known_before(key)]
    if not known:
        return shared_backgrounds(source, cameras, recipe, run, say)
    shown = _shown_backgrounds(source, known, recipe, run, say)
    others = [key for key in cameras if not shown.get(key)]
    shared = shared_backgrounds(source, others, recipe, run, lambda what, _: say(what, 0.0)) if others else {}
    return {**shared, **{key: found for key, found in shown.items() if found}}


def shared_backgrounds(
    source: LeRobotDatasetMetadata,
    cameras: list[str],
    recipe: Recipe,
    run: Run | None = None,
    say: Callable[[str, float], object] = lambda what, share: None,
) -> dict[str, list[SharedBackground]]:
    """Per camera, what some of its episodes show together, fitted once; one for every place in which it stood.

    Episodes that cannot be read are left out here, and reported when it is their turn. `run` calls a function with the
    source and each of some tasks, in this process or in others; by default in this one. `say` is told
    what is being done, and the share of all of it that is done since.
    """
    episodes = background_episodes(source, recipe)
    if not episodes:
        return {}
    views: dict[str, dict[tuple[int, int], View]] = {key: {} for key in cameras}  # by episode and stretch
    for index in episodes:
        say(f"background: reading episode {index}", READING / len(episodes))
        with contextlib.suppress(EpisodeError):
            episode, _ = read_recorded(source, index, cameras, recipe)
            for key, view in episode.views.items():
                for stand, window in enumerate(whole_stands(view, stands_of(view, recipe))):
                    views[key][index, stand] = window.few_frames(recipe.fit.max_width)
    backgrounds: dict[str, list[SharedBackground]] = {}
    for key, of_stands in views.items():
        indices = list(of_stands)

        def moving(
            numbers: Sequence[int], frames: Tensor, key: str = key, indices: list[tuple[int, int]] = indices
        ) -> Iterable[Tensor]:
            stands = [indices[number] for number in numbers]
            tasks = [MaskTask(episode, key, recipe, stand, frames.numpy()) for episode, stand in stands]
            look = functools.partial(moving_in_episode, source)
            masks = in_threads(look, tasks) if run is None else run(moving_in_episode, tasks)
            for task, mask in zip(tasks, masks, strict=True):
                yield torch.from_numpy(mask)
                say(
                    f"background: what moves in episode {task.episode} is known",
                    (1 - READING) / len(cameras) / len(tasks),
                )
            say(f"background: fitting {key}", 0.0)

        with torch_on_one_thread():
            backgrounds[key] = share_backgrounds(list(of_stands.values()), moving, recipe)
    return backgrounds


def _shown_backgrounds(
    source: LeRobotDatasetMetadata,
    cameras: list[str],
    recipe: Recipe,
    run: Run | None,
    say: Callable[[str, float], object],
) -> dict[str, list[Shown]]:
    """Per camera that moves, with poses in a world that episodes share, what each of some of them shows."""
    tasks = [ShownTask(index, key, recipe) for key in cameras for index in background_episodes(source, recipe)]
    look = functools.partial(shown_in_episode, source)
    found: dict[str, list[Shown]] = {key: [] for key in cameras}
    for task, shown in zip(tasks, map(look, tasks) if run is None else run(shown_in_episode, tasks), strict=True):
        say(f"background: what episode {task.episode} shows is known", 1 / len(tasks))
        if shown is not None:
            found[task.key].append(shown)
    return found


def shown_in_episode(source: LeRobotDatasetMetadata, task: ShownTask) -> Shown | None:
    """What an episode shows to others; None where its camera stands still, or its poses are in a world of its own."""
    try:
        view = read_recorded(source, task.episode, [task.key], task.recipe)[0].views[task.key]
        with torch_on_one_thread():
            return shown_by(view, task.recipe, task.episode, task.key)
    except (EpisodeError, PriorError) as error:  # reported when it is this episode's turn, if it is worked on
        logger.warning("shared background: episode %d is left out: %s", task.episode, error)
        return None


def moving_in_episode(source: LeRobotDatasetMetadata, task: MaskTask) -> UInt8[ndarray, "t h w"]:
    """What moves in those frames of a stretch that `few_frames` takes; everything, where no masks can be had."""
    view = read_recorded(source, task.episode, [task.key], task.recipe, recorded_depth=False)[0].views[task.key]
    whole = whole_stands(view, stands_of(view, task.recipe))[task.stand]
    try:
        with torch_on_one_thread():
            return moving_in_few(whole, task.recipe, torch.from_numpy(task.frames), task.episode, task.key).numpy()
    except PriorError as error:  # a file of masks may be there for some episodes alone
        logger.warning("shared background: episode %d is left out: %s", task.episode, error)
        return np.ones((len(few(len(whole.view))), *task.frames.shape[1:3]), np.uint8)


def background_episodes(source: LeRobotDatasetMetadata, recipe: Recipe) -> list[int]:
    """The episodes that `seen_together` looks at."""
    if not recipe.scene.shared_background or source.total_episodes < 2 or recipe.scenes is not None:
        return []
    return looked_at(source.total_episodes)


def background_worth(source: LeRobotDatasetMetadata, recipe: Recipe) -> float:
    """As many episodes as what `seen_together` takes as long as, about."""
    return (WORTH_SHOWN if any_known_before(source, recipe) else WORTH) * len(background_episodes(source, recipe))


def any_known_before(source: LeRobotDatasetMetadata, recipe: Recipe) -> bool:
    """Whether poses of any camera are known without its videos."""
    return any(recipe.camera.known_before(key) for key in colour_cameras(source))


def looked_at(episodes: int) -> list[int]:
    """Indices of those of a dataset's episodes that are looked at."""
    count = min(MAX_EPISODES, episodes)
    return sorted({round(i * (episodes - 1) / max(1, count - 1)) for i in range(count)})
