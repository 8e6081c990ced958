"""How long a run will take, from a few frames and steps of its first episode that can be read."""

import itertools
import logging
import shutil
import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.augment.backgrounds import any_known_before, background_episodes
from lerobot_msdyn.augment.earlier_scenes import earlier_scene
from lerobot_msdyn.augment.episode import by_feature
from lerobot_msdyn.augment.recorded import read_recorded
from lerobot_msdyn.augment.report.build import PICTURED
from lerobot_msdyn.core.compiled import time_spent_compiling
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import EpisodeError, OutputError
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.dataset.encode import stage_pictures
from lerobot_msdyn.reconstruction.reconstruct import FURTHER_STEPS, STEPS, Draft, reconstruct, with_steps
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.render.devices import chosen_device
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.views.pictures import for_many_views, new_pictures

logger = logging.getLogger(__name__)

PROBE_FRAMES = 24
PROBE_STEPS = 13  # after those that warm up, two rounds of looks at the whole picture and near what moves
REPORT_BYTES = 3e5  # of the report, for each view with pictures
MASKS_SHARE = 0.3  # of the time of priors and initial scene
GROWING = (
    "short_lived.",
    "overlay.",
    "shading.field",
    "shading.moving",
)  # tensors of a scene with a part for every frame
WARM_UP_STEPS = 4  # the first ones compile, and fill caches


@dataclass(frozen=True)
class Speeds:
    """Seconds that each part of the work takes, for all cameras together."""

    read_s: float  # per frame
    prepare_s: float  # per frame: priors and initial scene
    step_s: float  # per step of the fit
    render_s: float  # per new frame, encoded
    scene_bytes: float = 0.0  # of the saved scenes of an episode, however long ...
    frame_bytes: float = 0.0  # ... and for each of its frames
    video_bytes: float = 0.0  # per new frame: what was rendered and encoded as video
    videos: tuple[str, ...] = ()  # features that were


def first_speeds(source: LeRobotDatasetMetadata, episodes: Sequence[int], cameras: list[str], recipe: Recipe) -> Speeds:
    """Those of the first of the episodes that can be read and reconstructed.

    Raises:
        EpisodeError: none of them can; the first one's reason.
        PriorError: a prior was demanded and cannot be had.
    """
    errors = []
    for index in episodes:
        try:
            return measure_speeds(source, index, cameras, recipe)
        except EpisodeError as error:
            logger.warning("not measured: %s", error)
            errors.append(error)
    raise errors[0]


def measure_speeds(source: LeRobotDatasetMetadata, index: int, cameras: list[str], recipe: Recipe) -> Speeds:
    """Time every stage on the middle of one episode.

    Raises:
        EpisodeError: the episode cannot be read.
        PriorError: a prior was demanded and cannot be had.
    """
    start = time.perf_counter()
    episode, _ = read_recorded(source, index, cameras, recipe)
    frames = len(episode.time)
    read_s = (time.perf_counter() - start) / frames
    short = replace(
        recipe,
        fit=replace(recipe.fit, steps=PROBE_STEPS, held_out_frames=0),
        priors=replace(recipe.priors, cache="off"),
    )
    views = episode.views
    if not recipe.needs_whole_videos:
        views = {key: _middle(view) for key, view in views.items()}
    prepare_s = step_s = render_s = scene_bytes = frame_bytes = video_bytes = 0.0
    videos: list[str] = []
    for key, part in views.items():
        times = torch.arange(len(part.rgb))
        if recipe.scenes is None:
            others = [other for name, other in views.items() if name != key]
            scene, of_priors, of_step = _timed_fit(part, short, others, index, key)
            prepare_s, step_s = prepare_s + of_priors, step_s + of_step
        else:
            scene, times = earlier_scene(recipe.scenes, index, key), times + (frames - len(part)) // 2
        once, each = _saved_sizes(scene.windows[0].scene)
        scene_bytes, frame_bytes = scene_bytes + once, frame_bytes + each
        with tempfile.TemporaryDirectory() as folder, time_spent_compiling() as compiling_s:
            start = time.perf_counter()
            scene_here = for_many_views(scene, chosen_device(recipe.device))
            pictures = by_feature(source, {key: new_pictures(scene_here, scene.camera.select(times), times)})
            staged = stage_pictures(source, Path(folder), pictures, len(part.rgb))
            render_s += (time.perf_counter() - start - compiling_s()) / len(part.rgb)
            videos += staged.videos
            video_bytes += sum(file.stat().st_size for file in staged.videos.values()) / len(part.rgb)
    return Speeds(read_s, prepare_s, step_s, render_s, scene_bytes, frame_bytes, video_bytes, tuple(videos))


def _timed_fit(
    part: View, recipe: Recipe, others: Sequence[View], index: int, key: str
) -> tuple[Reconstruction, float, float]:
    """A camera's reconstruction, and the seconds that priors and initial scene take per frame, and a step of the fit.

    Without what compiling takes: that is once per machine, and not for each frame.
    """
    ticks: list[float] = []
    fit_s: list[float] = []
    with time_spent_compiling() as compiling_s:
        start = time.perf_counter()

        def fitted(draft: Draft) -> None:
            begin = time.perf_counter() - compiling_s()
            STEPS["fit"](draft)
            fit_s.append(time.perf_counter() - compiling_s() - begin)

        def tick(share: float) -> None:
            ticks.append(time.perf_counter())

        scene = reconstruct(
            part, recipe, tick, others=others, episode=index, key=key, steps=with_steps({"fit": fitted})
        )
        prepare_s = (time.perf_counter() - start - compiling_s() - sum(fit_s)) / len(part.rgb)
    late = ticks[WARM_UP_STEPS:]
    steps = [after - before for before, after in itertools.pairwise(late)]
    return scene, prepare_s, statistics.fmean(steps)


def predicted_output_bytes(
    source: LeRobotDatasetMetadata, episodes: Sequence[int], rendered: Sequence[int], recipe: Recipe
) -> float:
    """Disk for the new dataset without saved scenes: each of its frames takes what one of the source takes.

    Args:
        source: the dataset.
        episodes: those that are used.
        rendered: those of them that get new ones.
        recipe: the settings.
    """
    frames = frames_of(source, rendered) * recipe.variants + frames_of(source, episodes) * int(recipe.include_source)
    return _size_of(source, "data", "videos") * frames / max(source.total_frames, 1)


def predicted_bytes(
    speeds: Speeds, source: LeRobotDatasetMetadata, episodes: list[int], rendered: list[int], recipe: Recipe
) -> float:
    """Disk for the new dataset without saved scenes, its new videos as a few of their frames were encoded."""
    frames = frames_of(source, rendered)
    copied = predicted_output_bytes(source, episodes, rendered, recipe)
    share = frames / max(source.total_frames, 1)
    recorded = _size_of(source, *(f"videos/{key}" for key in speeds.videos)) * share
    views = len(rendered) * recipe.variants * len(speeds.videos)
    report = REPORT_BYTES * min(views, PICTURED)
    return copied + recipe.variants * (frames * speeds.video_bytes - recorded) + report


def frames_of(source: LeRobotDatasetMetadata, episodes: Sequence[int]) -> int:
    """Of some episodes together."""
    return sum(int(source.episodes[index]["length"]) for index in episodes)


def _size_of(source: LeRobotDatasetMetadata, *folders: str) -> int:
    """Bytes of all files in some folders of a dataset."""
    files = (file for folder in folders for file in (source.root / folder).rglob("*") if file.is_file())
    return sum(file.stat().st_size for file in files)


def check_disk(
    source: LeRobotDatasetMetadata, episodes: list[int], rendered: list[int], recipe: Recipe, folder: Path
) -> None:
    """Whether a run has the disk that it will take: the output, and as much again while it is made.

    Args:
        source: the dataset.
        episodes: those that are used.
        rendered: those of them that get new ones.
        recipe: the settings.
        folder: the work folder; what an unfinished run has left in it counts as written.

    Raises:
        OutputError: not even the output fits.
    """
    output = predicted_output_bytes(source, episodes, rendered, recipe)
    there = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    free = shutil.disk_usage(folder).free
    if free + there < output:
        raise OutputError(
            f"{folder.parent} has {free / 1e6:.0f} MB of free disk; the output takes about {output / 1e6:.0f} MB, and "
            "as much again while it is made: make room there, choose another --new_root, or fewer --episodes or "
            "--variants"
        )
    if free + there < 2 * output:
        logger.warning(
            "%s has %.0f MB of free disk; making the output takes about %.0f MB: it may not suffice",
            folder.parent,
            free / 1e6,
            2 * output / 1e6,
        )


def predicted_scene_bytes(speeds: Speeds, source: LeRobotDatasetMetadata, episodes: list[int], recipe: Recipe) -> float:
    """Disk for the saved scenes of a whole run; a window of a long episode has a scene of its own."""
    lengths = [int(source.episodes[index]["length"]) for index in episodes]
    windows = sum(-(-frames // recipe.fit.window_frames) for frames in lengths)
    return windows * speeds.scene_bytes + sum(lengths) * speeds.frame_bytes


def predicted_seconds(
    speeds: Speeds, source: LeRobotDatasetMetadata, episodes: list[int], recipe: Recipe, workers: int = 1
) -> float:
    """Time of a whole run by so many workers; `speeds` are those of one, on its share of the cores."""
    background_s = predicted_background_seconds(speeds, source, episodes, recipe, workers)
    return background_s + predicted_episode_seconds(speeds, source, episodes, recipe, workers)


def predicted_background_seconds(
    speeds: Speeds, source: LeRobotDatasetMetadata, episodes: list[int], recipe: Recipe, workers: int = 1
) -> float:
    """The part of it before any episode, in which what all share is made."""
    indices = background_episodes(source, recipe)
    if not indices:
        return 0.0
    per_frame = source.total_frames / source.total_episodes
    if any_known_before(source, recipe):  # each shows what it has; cameras that stand still are taken for moving ones
        return len(indices) * (speeds.read_s + speeds.prepare_s) / workers * per_frame
    apart = len(set(indices) - set(episodes))  # the masks of the others serve for their own fit as well
    masks_s = (len(indices) * speeds.read_s + apart * MASKS_SHARE * speeds.prepare_s) / workers
    each_s = len(indices) * speeds.read_s + masks_s
    return each_s * per_frame + recipe.fit.steps / 2 * speeds.step_s


def predicted_episode_seconds(
    speeds: Speeds, source: LeRobotDatasetMetadata, episodes: list[int], recipe: Recipe, workers: int = 1
) -> float:
    """The part of it for episodes, some of a run's."""
    fitted_before = background_episodes(source, recipe) and not any_known_before(source, recipe)
    steps = recipe.fit.steps * (FURTHER_STEPS if fitted_before else 1.0)
    busy_s = [0.0] * workers
    for index in episodes:
        frames = int(source.episodes[index]["length"])
        windows = -(-frames // recipe.fit.window_frames)
        one_s = frames * (speeds.read_s + speeds.prepare_s + recipe.variants * speeds.render_s)
        busy_s[busy_s.index(min(busy_s))] += one_s + windows * steps * speeds.step_s
    return max(busy_s)


def _saved_sizes(scene: DynamicScene) -> tuple[float, float]:
    """Bytes of a scene that do not grow with its length, and those of each frame."""
    sizes = {name: tensor.nbytes for name, tensor in scene.tensors().items()}
    growing = sum(size for name, size in sizes.items() if name.startswith(GROWING))
    return float(sum(sizes.values()) - growing), growing / scene.frames


def _middle(view: View) -> View:
    start = max(0, (len(view) - PROBE_FRAMES) // 2)
    return view.select(slice(start, start + PROBE_FRAMES))
