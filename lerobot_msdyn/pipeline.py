"""The whole flow on one screen: an episode in, a scene per camera, new episodes out."""

import contextlib
import functools
import itertools
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_msdyn import saved
from lerobot_msdyn.background import empty_scene
from lerobot_msdyn.bounds import NewCameras, new_cameras
from lerobot_msdyn.cameras import concatenated, read_calibration
from lerobot_msdyn.config import OtherCameraConfig, Recipe, SceneConfig
from lerobot_msdyn.coverage import Evidence, evidence_of
from lerobot_msdyn.episode import View, depth_key_of, read_episode, shrink
from lerobot_msdyn.errors import ConfigError, EpisodeError
from lerobot_msdyn.fitting import FitResult, fit
from lerobot_msdyn.initialisation import initialise
from lerobot_msdyn.perturbation import look_at_distance
from lerobot_msdyn.priors import PointTracks, Priors, estimate_priors
from lerobot_msdyn.provenance import SOURCE_VARIANT, Provenance, camera_pose
from lerobot_msdyn.saved import SavedScene, SceneSource
from lerobot_msdyn.shared import (
    MAX_EPISODES,
    SharedBackground,
    adapted,
    completed,
    few_frames,
    share_backgrounds,
)
from lerobot_msdyn.unexplained import unexplained
from lerobot_msdyn.views import Picture, Reconstruction, UnseenMasks, new_pictures
from lerobot_msdyn.write import NewEpisode, OutputDataset

logger = logging.getLogger(__name__)

SHARP_DEPTH = ("recorded", "plane")  # providers whose depth has sharp edges and agrees between frames
ROUGH_BORDER_PX = 2  # with the others' depth: from the border of a mask ...
ROUGH_FRAMES = 6  # ... and so few frames are gathered, whose depths disagree
ATTEMPTS = 3  # draws of one new episode before it is given up
FURTHER_STEPS = 0.6  # share of the fit's steps that suffices where the static set has been fitted already

Backgrounds = Mapping[str, Sequence[SharedBackground]]  # by camera
Progress = Callable[[str, float], object]  # (what is being done, share of the episode done since the last call)


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
    other = _other_pose(recipe, index, episode.views[cameras[0]])
    new = []
    if recipe.include_source:
        new.append(NewEpisode(index, Provenance(source.repo_id, index, SOURCE_VARIANT, recipe.seed, {}, priors)))
    for variant in range(recipe.variants):
        progress(f"episode {index}: rendering variant {variant}", 0.0)
        found = _accepted(scenes, recipe, index, variant, other)
        if found is not None:
            new.append(_staged(source, index, variant, recipe, output, scenes, found))
        progress("", 0.5 / recipe.variants)
    if recipe.save_scenes:
        for key, scene in scenes.items():
            saved.save(to_saved(scene, SceneSource(source.repo_id, index, key, source.fps)), output.scenes)
    return new


def to_saved(scene: Reconstruction, source: SceneSource) -> SavedScene:
    """What of a reconstruction is kept."""
    windows = tuple(result.scene for result in scene.results)
    return SavedScene(source, windows, scene.starts, scene.camera, scene.metric, scene.distance, scene.provenance)


def _accepted(
    scenes: Mapping[str, Reconstruction], recipe: Recipe, index: int, variant: int, other: Tensor | None
) -> NewCameras | None:
    """The cameras of one new episode, drawn again where they show too much that was never seen; None: given up."""
    for attempt in range(ATTEMPTS):
        found = new_cameras(scenes, recipe, index, variant, attempt, other)
        if not found.rejected:
            return found
        logger.warning("episode %d variant %d, draw %d: rejected: %s", index, variant, attempt, found.rejected)
    return None


def _staged(
    source: LeRobotDatasetMetadata,
    index: int,
    variant: int,
    recipe: Recipe,
    output: OutputDataset,
    scenes: Mapping[str, Reconstruction],
    found: NewCameras,
) -> NewEpisode:
    """One new episode, rendered and encoded."""
    pictures = {key: new_pictures(scene, found.cameras[key], fill=recipe.fill) for key, scene in scenes.items()}
    masks = UnseenMasks() if recipe.masks else None
    if masks is not None:
        pictures = {key: masks.kept(key, some) for key, some in pictures.items()}
    provenance = Provenance(
        source.repo_id,
        index,
        variant,
        recipe.seed,
        found.drawn,
        {key: scene.provenance for key, scene in scenes.items()},
        {key: camera_pose(scene.camera, found.cameras[key]) for key, scene in scenes.items()},
    )
    new = output.stage(index, variant, by_feature(source, pictures), provenance)
    return new if masks is None else replace(new, masks=masks.arrays())


def _other_pose(recipe: Recipe, index: int, view: View) -> Tensor | None:
    """World from the camera that `other_camera` names."""
    config = recipe.perturbation
    if not isinstance(config, OtherCameraConfig):
        return None
    camera = None
    if recipe.camera.calibration is not None:
        height, width = view.rgb.shape[1:3]
        camera = read_calibration(recipe.camera.calibration, config.camera, index, 1, width, height)
    if camera is None:
        raise ConfigError(
            f"perturbation.camera is {config.camera!r}, which the calibration {recipe.camera.calibration} does not "
            "name; expected a camera with K, R and t there (--camera.calibration FILE)"
        )
    return camera.world_from_camera[0]


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
    results, known, distances, evidence = zip(*fitted, strict=True)
    starts = tuple(start for start, _ in windows)
    camera = concatenated([part.camera for part in evidence]).resized(view.camera.width, view.camera.height)
    return Reconstruction(results, starts, known[0].metric, known[0].provenance, camera, distances[0], evidence)


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
) -> tuple[FitResult, Priors, float, Evidence]:
    """A fitted scene of one window, its priors, look-at distance (m) and what was recorded, at the size of the fit."""
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
    if settings.overlay:
        result = replace(result, scene=replace(result.scene, overlay=unexplained(result.scene, view, priors)))
    return result, priors, distance, evidence_of(result.scene, view.camera, empty)


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
