"""The whole flow on one screen: an episode in, a scene per camera, new episodes out."""

import contextlib
import functools
import itertools
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_msdyn import saved
from lerobot_msdyn.background import empty_scene
from lerobot_msdyn.cameras import CameraTrack, concatenated
from lerobot_msdyn.config import Recipe, SceneConfig
from lerobot_msdyn.episode import View, depth_key_of, read_episode, shrink
from lerobot_msdyn.errors import EpisodeError
from lerobot_msdyn.fitting import FitResult, fit
from lerobot_msdyn.initialisation import initialise
from lerobot_msdyn.perturbation import draw_offset, draw_rng, look_at_distance, perturb
from lerobot_msdyn.priors import PointTracks, Priors, estimate_priors
from lerobot_msdyn.provenance import SOURCE_VARIANT, Provenance
from lerobot_msdyn.quality import HOLE_ALPHA, fill_holes
from lerobot_msdyn.rendering import render_frames
from lerobot_msdyn.saved import SavedScene, SceneSource
from lerobot_msdyn.shared import (
    MAX_EPISODES,
    SharedBackground,
    adapted,
    completed,
    few_frames,
    share_backgrounds,
)
from lerobot_msdyn.write import NewEpisode, OutputDataset

logger = logging.getLogger(__name__)

SHARP_DEPTH = ("recorded", "plane")  # providers whose depth has sharp edges and agrees between frames
ROUGH_BORDER_PX = 2  # with the others' depth: from the border of a mask ...
ROUGH_FRAMES = 6  # ... and so few frames are gathered, whose depths disagree
FURTHER_STEPS = 0.6  # share of the fit's steps that suffices where the static set has been fitted already

Backgrounds = Mapping[str, Sequence[SharedBackground]]  # by camera
Progress = Callable[[str, float], object]  # (what is being done, share of the episode done since the last call)


@dataclass(frozen=True)
class Reconstruction:
    """One camera's scenes, one per window of its video, and what was known about it."""

    results: tuple[FitResult, ...]
    starts: tuple[int, ...]  # first frame of each window
    metric: bool  # whether depth is in true metres
    provenance: dict[str, dict[str, str]]  # prior -> provider, why, model and licence, of the first window
    camera: CameraTrack  # at the size of the recorded video
    distance: float  # m, to the look-at point

    @property
    def seconds(self) -> float:
        """Time that was spent in fitting."""
        return sum(result.seconds for result in self.results)


@dataclass(frozen=True)
class Picture:
    """One frame of a new view."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]  # m, z-depth; 0 where nothing is known, and everywhere if there is no true scale


def shared_backgrounds(source: LeRobotDatasetMetadata, cameras: list[str], recipe: Recipe) -> Backgrounds:
    """Per camera, what some of its episodes show together, fitted once; one for every place in which it stood.

    Episodes that cannot be read are left out here, and reported when it is their turn.
    """
    if not recipe.scene.shared_background or source.total_episodes < 2:
        return {}
    views: dict[str, list[View]] = {key: [] for key in cameras}
    count = min(MAX_EPISODES, source.total_episodes)
    for index in sorted({round(i * (source.total_episodes - 1) / (count - 1)) for i in range(count)}):
        with contextlib.suppress(EpisodeError):
            episode = read_episode(source, index, cameras, recipe.camera, recorded_depth=recipe.priors.depth != "plane")
            for key, view in episode.views.items():
                views[key].append(shrink(few_frames(view), recipe.fit.max_width))
    with _one_torch_thread():
        found = {key: share_backgrounds(some) for key, some in views.items()}
    return {key: [_fitted(background, recipe) for background in some] for key, some in found.items()}


def _fitted(background: SharedBackground, recipe: Recipe) -> SharedBackground:
    """A shared background with a static set that was fitted to its picture; without depth there is none."""
    empty, camera = background.empty, background.camera
    if not bool((empty.depth > 0).any()):
        return background
    nothing = torch.zeros(1, *empty.seen.shape, dtype=torch.uint8)
    priors = Priors(empty.depth[None], nothing, empty.rgb, _no_tracks(), metric=True)
    view = View(empty.rgb[None], camera)
    scene = initialise(view, priors, replace(recipe.scene, moving_gaussians=0), recipe.motion, empty)
    config = replace(recipe.fit, steps=recipe.fit.steps // 2, shadows=False, held_out_frames=0)
    try:
        result = fit(scene, view, priors, config, distance=look_at_distance(empty.depth), seed=recipe.seed)
    except EpisodeError as error:
        logger.warning("shared background: %s; every episode fits its own", error)
        return background
    return replace(background, static=result.scene.static)


def _no_tracks() -> PointTracks:
    none = torch.zeros(0, 1)
    return PointTracks(torch.zeros(0, 1, 2), none.bool(), none, torch.zeros(0, dtype=torch.long))


def augment_episode(
    source: LeRobotDatasetMetadata,
    index: int,
    cameras: list[str],
    recipe: Recipe,
    output: OutputDataset,
    progress: Progress = lambda what, share: None,
    backgrounds: Backgrounds | None = None,
) -> list[NewEpisode]:
    """All new episodes of one source episode, staged in the output; `backgrounds` come from `shared_backgrounds`.

    Raises:
        EpisodeError: the episode cannot be read.
        PriorError: a prior was demanded and cannot be had.
    """
    episode = read_episode(source, index, cameras, recipe.camera, recorded_depth=recipe.priors.depth != "plane")
    scenes = {}
    for key, view in episode.views.items():
        progress(f"episode {index}: fitting {key}", 0.0)
        scenes[key] = reconstruct(
            view,
            recipe,
            lambda share: progress("", 0.5 * share / len(cameras)),
            (backgrounds or {}).get(key, []),
            others=[other for name, other in episode.views.items() if name != key],
            episode=index,
            key=key,
        )
    priors = {key: scene.provenance for key, scene in scenes.items()}
    new = []
    if recipe.include_source:
        new.append(NewEpisode(index, Provenance(source.repo_id, index, SOURCE_VARIANT, recipe.seed, {}, priors)))
    for variant in range(recipe.variants):
        progress(f"episode {index}: rendering variant {variant}", 0.0)
        rng = draw_rng(recipe.seed, index, variant)
        pictures, drawn = {}, {}
        for key, scene in scenes.items():
            offset, drawn[key] = draw_offset(recipe.perturbation, scene.distance, rng)
            pictures[key] = new_pictures(scene, perturb(scene.camera, offset))
        provenance = Provenance(source.repo_id, index, variant, recipe.seed, drawn, priors)
        new.append(output.stage(index, variant, by_feature(source, pictures), provenance))
        progress("", 0.5 / recipe.variants)
    if recipe.save_scenes:
        for key, scene in scenes.items():
            saved.save(to_saved(scene, SceneSource(source.repo_id, index, key, source.fps)), output.scenes)
    return new


def to_saved(scene: Reconstruction, source: SceneSource) -> SavedScene:
    """What of a reconstruction is kept."""
    windows = tuple(result.scene for result in scene.results)
    return SavedScene(
        source, windows, scene.starts, scene.camera, scene.metric, scene.distance, scene.provenance
    )


def reconstruct(
    view: View,
    recipe: Recipe,
    progress: Callable[[float], object] = lambda share: None,
    backgrounds: Sequence[SharedBackground] = (),
    *,
    others: Sequence[View] = (),
    episode: int | None = None,
    key: str | None = None,
) -> Reconstruction:
    """Priors, initial scene and fit of one camera's video; the first of the shared backgrounds that fits is used.

    Long videos are cut into windows, each with priors and a scene of its own, so that memory beyond the video itself
    is that of one window. Windows share a background as episodes do. The last arguments are those of
    `estimate_priors`.
    """
    windows = _windows(view, recipe)
    if len(windows) > 1 and not backgrounds and recipe.scene.shared_background:
        some = [shrink(few_frames(window), recipe.fit.max_width) for _, window in windows]
        backgrounds = [_fitted(background, recipe) for background in share_backgrounds(some)]
    beside = [[shrink(window, recipe.fit.max_width) for _, window in _windows(other, recipe)] for other in others]
    fitted = []
    for number, (_, window) in enumerate(windows):

        def within(share: float, done: int = number) -> object:
            return progress((done + share) / len(windows))

        priors_of = functools.partial(
            estimate_priors,
            config=recipe.priors,
            camera=recipe.camera,
            others=[parts[number] for parts in beside],
            episode=episode,
            key=key,
            device=recipe.device,
        )
        fitted.append(_fit_window(shrink(window, recipe.fit.max_width), recipe, within, backgrounds, priors_of))
    results, known, distances, cameras = zip(*fitted, strict=True)
    starts = tuple(start for start, _ in windows)
    camera = concatenated(cameras).resized(view.camera.width, view.camera.height)
    return Reconstruction(results, starts, known[0].metric, known[0].provenance, camera, distances[0])


def _windows(view: View, recipe: Recipe) -> list[tuple[int, View]]:
    """First frames and parts of a video, of about equal length; priors from a file are for the whole video."""
    frames = len(view.rgb)
    count = 1 if recipe.needs_whole_videos else -(-frames // recipe.fit.window_frames)
    bounds = [round(i * frames / count) for i in range(count + 1)]
    parts = []
    for start, end in itertools.pairwise(bounds):
        depth = None if view.depth is None else view.depth[start:end]
        parts.append((start, View(view.rgb[start:end], view.camera.select(slice(start, end)), depth, view.depth_range)))
    return parts


def _fit_window(
    view: View,
    recipe: Recipe,
    progress: Callable[[float], object],
    backgrounds: Sequence[SharedBackground],
    priors_of: Callable[..., Priors],
) -> tuple[FitResult, Priors, float, CameraTrack]:
    """A fitted scene of one window at the size at which it is fitted, its priors, look-at distance (m) and camera."""
    steps, settings = recipe.fit.steps, recipe.scene
    with _one_torch_thread():
        shared = next((background for background in backgrounds if background.fits(view)), None)
        priors = priors_of(view, elsewhere=None if shared is None else shared.frames)
        view = replace(view, camera=priors.camera or view.camera)
        if shared is not None and not shared.fits(view):  # another camera than was assumed at first
            shared = None
        if not view.camera.is_static:
            logger.warning("the camera moves, but the empty scene is built as if it were fixed: expect blur")
        if priors.provenance["depth"]["provider"] not in SHARP_DEPTH:
            settings = _for_rough_depth(settings)
        empty = empty_scene(view.rgb, priors.depth, priors.instances)
        if shared is not None:
            empty = completed(empty, shared.empty)
        priors = replace(priors, empty=empty.rgb)
        distance = look_at_distance(empty.depth)
        scene = initialise(view, priors, settings, recipe.motion, empty)
        if shared is not None and shared.static is not None:
            scene = replace(scene, static=adapted(shared, empty, scene.static))
            steps = round(FURTHER_STEPS * steps)
    result = fit(
        scene,
        view,
        priors,
        replace(recipe.fit, steps=steps),
        distance=distance,
        seed=recipe.seed,
        progress=lambda done: progress(done / steps),
    )
    return result, priors, distance, view.camera


def _for_rough_depth(scene: SceneConfig) -> SceneConfig:
    """Settings for depth that is uncertain near edges, and disagrees between frames."""
    return replace(
        scene,
        mask_border_px=max(scene.mask_border_px, ROUGH_BORDER_PX),
        moving_frames=min(scene.moving_frames, ROUGH_FRAMES),
    )


@contextlib.contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Thousands of small solves are several times slower when torch spreads each over all cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def by_feature(
    source: LeRobotDatasetMetadata, pictures: dict[str, Iterator[Picture]]
) -> Iterator[dict[str, np.ndarray]]:
    """Per time, feature -> picture: the cameras in step, and the depth of those that have a depth feature."""
    for together in zip(*pictures.values(), strict=True):
        features: dict[str, np.ndarray] = {}
        for key, picture in zip(pictures, together, strict=True):
            features[key] = picture.rgb
            depth_key = depth_key_of(source, key)
            if depth_key is not None:
                features[depth_key] = picture.depth
        yield features


def new_pictures(scene: Reconstruction, camera: CameraTrack, frames: Tensor | None = None) -> Iterator[Picture]:
    """The scene through another camera, holes filled; the share of holes is logged at the end.

    `frames` (int, [t]) are those that the poses of `camera` belong to; default: all.
    """
    frames = torch.arange(len(scene.camera)) if frames is None else frames
    window = torch.searchsorted(torch.tensor(scene.starts), frames, right=True) - 1
    holes: list[float] = []
    for index, count in zip(
        *(values.tolist() for values in window.unique_consecutive(return_counts=True)), strict=True
    ):
        part = slice(len(holes), len(holes) + count)
        result, times = scene.results[index], frames[part] - scene.starts[index]
        for rendering in render_frames(result.scene, camera.select(part), times):
            drawn = (rendering.rgb.clamp(0, 1) * 255).round().to(torch.uint8)
            for rgb, alpha, depth in zip(drawn.numpy(), rendering.alpha.numpy(), rendering.depth.numpy(), strict=True):
                filled, share = fill_holes(rgb, alpha)
                holes.append(share)
                yield Picture(filled, np.where((alpha >= HOLE_ALPHA) & scene.metric, depth, np.float32(0)))
    logger.info("%.1f %% of the pixels were filled in (worst frame %.1f %%)", 100 * np.mean(holes), 100 * max(holes))
