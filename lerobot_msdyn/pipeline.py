"""The whole flow on one screen: an episode in, a scene per camera, new episodes out."""

import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_msdyn.background import empty_scene
from lerobot_msdyn.cameras import CameraTrack
from lerobot_msdyn.config import Recipe
from lerobot_msdyn.episode import View, depth_key_of, read_episode
from lerobot_msdyn.errors import EpisodeError
from lerobot_msdyn.fitting import FitResult, fit
from lerobot_msdyn.initialisation import initialise
from lerobot_msdyn.perturbation import draw_offset, draw_rng, look_at_distance, perturb
from lerobot_msdyn.priors import PointTracks, Priors, estimate_priors
from lerobot_msdyn.provenance import SOURCE_VARIANT, Provenance
from lerobot_msdyn.quality import HOLE_ALPHA, fill_holes
from lerobot_msdyn.rendering import render_frames, resized
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

FURTHER_STEPS = 0.6  # share of the fit's steps that suffices where the static set has been fitted already

Backgrounds = Mapping[str, Sequence[SharedBackground]]  # by camera
Progress = Callable[[str, float], object]  # (what is being done, share of the episode done since the last call)


@dataclass(frozen=True)
class Reconstruction:
    """One camera's scene and what was known about its video."""

    result: FitResult
    priors: Priors
    camera: CameraTrack  # at the size of the recorded video
    distance: float  # m, to the look-at point


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
    result = fit(scene, view, priors, config, distance=look_at_distance(empty.depth), seed=recipe.seed)
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
        shared = (backgrounds or {}).get(key, [])
        scenes[key] = reconstruct(view, recipe, lambda share: progress("", 0.5 * share / len(cameras)), shared)
    priors = {key: scene.priors.provenance for key, scene in scenes.items()}
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
    return new


def reconstruct(
    view: View,
    recipe: Recipe,
    progress: Callable[[float], object] = lambda share: None,
    backgrounds: Sequence[SharedBackground] = (),
) -> Reconstruction:
    """Priors, initial scene and fit of one camera's video; the first of the shared backgrounds that fits is used."""
    camera = view.camera
    view = shrink(view, recipe.fit.max_width)
    with _one_torch_thread():
        priors = estimate_priors(view, recipe.priors, recipe.camera)
        empty = empty_scene(view.rgb, priors.depth, priors.instances)
        shared = next((background for background in backgrounds if background.fits(view)), None)
        if shared is not None:
            empty = completed(empty, shared.empty)
        priors = replace(priors, empty=empty.rgb)
        distance = look_at_distance(empty.depth)
        scene = initialise(view, priors, recipe.scene, recipe.motion, empty)
        steps = recipe.fit.steps
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
    return Reconstruction(result, priors, camera, distance)


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
    """The scene's frames through another camera, holes filled; the share of holes is logged at the end."""
    holes = []
    for rendering in render_frames(scene.result.scene, camera, frames):
        drawn = (rendering.rgb.clamp(0, 1) * 255).round().to(torch.uint8)
        for rgb, alpha, depth in zip(drawn.numpy(), rendering.alpha.numpy(), rendering.depth.numpy(), strict=True):
            filled, share = fill_holes(rgb, alpha)
            holes.append(share)
            known = (alpha >= HOLE_ALPHA) & scene.priors.metric
            yield Picture(filled, np.where(known, depth, np.float32(0)))
    logger.info("%.1f %% of the pixels were filled in (worst frame %.1f %%)", 100 * np.mean(holes), 100 * max(holes))


def shrink(view: View, max_width: int) -> View:
    """The same video with at most `max_width` columns; depth keeps its values (nearest pixel)."""
    height, width = view.rgb.shape[1:3]
    if width <= max_width:
        return view
    size = (max_width, round(height * max_width / width))
    rgb = np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in view.rgb.numpy()])
    depth: Float[Tensor, "t h w"] | None = None
    if view.depth is not None:
        images = [cv2.resize(image, size, interpolation=cv2.INTER_NEAREST) for image in view.depth.numpy()]
        depth = torch.from_numpy(np.stack(images))
    return View(torch.from_numpy(rgb), resized(view.camera, *size), depth, view.depth_range)
