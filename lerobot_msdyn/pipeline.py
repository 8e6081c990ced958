"""The whole flow on one screen: an episode in, a scene per camera, new episodes out."""

import contextlib
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_msdyn.cameras import CameraTrack
from lerobot_msdyn.config import Recipe
from lerobot_msdyn.episode import View, depth_key_of, read_episode, shrink
from lerobot_msdyn.fitting import FitResult, fit
from lerobot_msdyn.initialisation import initialise
from lerobot_msdyn.perturbation import draw_offset, draw_rng, look_at_distance, perturb
from lerobot_msdyn.priors import Priors, estimate_priors
from lerobot_msdyn.priors.depth import static_depth
from lerobot_msdyn.provenance import SOURCE_VARIANT, Provenance
from lerobot_msdyn.quality import HOLE_ALPHA, fill_holes
from lerobot_msdyn.rendering import render_frames
from lerobot_msdyn.write import NewEpisode, OutputDataset

logger = logging.getLogger(__name__)

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


def augment_episode(
    source: LeRobotDatasetMetadata,
    index: int,
    cameras: list[str],
    recipe: Recipe,
    output: OutputDataset,
    progress: Progress = lambda what, share: None,
) -> list[NewEpisode]:
    """All new episodes of one source episode, staged in the output.

    Raises:
        EpisodeError: the episode cannot be read.
        PriorError: a prior was demanded and cannot be had.
    """
    episode = read_episode(source, index, cameras, recipe.camera, recorded_depth=recipe.priors.depth != "plane")
    scenes = {}
    for key, view in episode.views.items():
        progress(f"episode {index}: fitting {key}", 0.0)
        others = [other for name, other in episode.views.items() if name != key]
        scenes[key] = reconstruct(
            view,
            recipe,
            lambda share: progress("", 0.5 * share / len(cameras)),
            others=others,
            episode=index,
            key=key,
        )
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
    *,
    others: Sequence[View] = (),
    episode: int | None = None,
    key: str | None = None,
) -> Reconstruction:
    """Priors, initial scene and fit of one camera's video; the other arguments are those of `estimate_priors`."""
    width, height = view.camera.width, view.camera.height
    view = shrink(view, recipe.fit.max_width)
    others = [shrink(other, recipe.fit.max_width) for other in others]
    with _one_torch_thread():
        priors = estimate_priors(
            view, recipe.priors, recipe.camera, others=others, episode=episode, key=key, device=recipe.device
        )
        view = replace(view, camera=priors.camera or view.camera)
        if not view.camera.is_static:
            logger.warning("the camera moves, but the empty scene is built as if it were fixed: expect blur")
        distance = look_at_distance(static_depth(priors.depth, priors.instances))
        scene = initialise(view, priors, recipe.scene, recipe.motion)
    result = fit(
        scene,
        view,
        priors,
        recipe.fit,
        distance=distance,
        seed=recipe.seed,
        progress=lambda steps: progress(steps / recipe.fit.steps),
    )
    return Reconstruction(result, priors, view.camera.resized(width, height), distance)


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
