"""The whole flow on one screen: an episode in, a scene per camera, new episodes out."""

import functools
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_msdyn.core.cameras import concatenated, read_calibration
from lerobot_msdyn.core.config import OtherCameraConfig, Recipe, SceneConfig
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.dataset.provenance import SOURCE_VARIANT, Provenance, camera_pose, merged
from lerobot_msdyn.dataset.read import View, depth_key_of, read_episode, shrink
from lerobot_msdyn.dataset.staging import SCENE
from lerobot_msdyn.dataset.write import NewEpisode, OutputDataset
from lerobot_msdyn.priors import Priors, estimate_priors
from lerobot_msdyn.reconstruct.antialias import enlarged
from lerobot_msdyn.reconstruct.background import empty_scene
from lerobot_msdyn.reconstruct.fit import FitResult, fit
from lerobot_msdyn.reconstruct.initialise import initialise
from lerobot_msdyn.reconstruct.make_overlay import unexplained
from lerobot_msdyn.reconstruct.pooled_background import (
    SharedBackground,
    adapted,
    completed,
    few_frames,
)
from lerobot_msdyn.reconstruct.prune import without_disproved
from lerobot_msdyn.reconstruct.self_check import Witness, witness
from lerobot_msdyn.reconstruct.share_background import NEAR, Backgrounds, moving_in_few, share, windows
from lerobot_msdyn.render.cpu.threads import torch_on_one_thread
from lerobot_msdyn.render.devices import chosen_device
from lerobot_msdyn.scene import store as saved
from lerobot_msdyn.scene.store import SavedScene, SceneSource
from lerobot_msdyn.views.coverage import Evidence, evidence_of
from lerobot_msdyn.views.gate import judge, reasons, record
from lerobot_msdyn.views.new_cameras import NewCameras, new_cameras
from lerobot_msdyn.views.perturbation import look_at_distance
from lerobot_msdyn.views.pictures import Picture, Reconstruction, UnseenMasks, new_pictures, on_device

logger = logging.getLogger(__name__)

SHARP_DEPTH = ("recorded", "plane")  # providers whose depth has sharp edges and agrees between frames
ROUGH_BORDER_PX = 2  # with the others' depth: from the border of a mask ...
ROUGH_FRAMES = 6  # ... and so few frames are gathered, whose depths disagree
FURTHER_STEPS = 0.6  # share of the fit's steps that suffices where the static set has been fitted already

Progress = Callable[[str, float], object]  # (what is being done, share of the episode done since the last call)


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

    What an earlier run has finished of it is taken from the output's work folder.

    Raises:
        EpisodeError: the episode cannot be read.
        PriorError: a prior was demanded and cannot be had.
    """
    episode = read_episode(source, index, cameras, recipe.camera, recorded_depth=recipe.priors.depth != "plane")
    kept = output.episode(index)
    scenes = {}
    for key, view in episode.views.items():
        progress(f"episode {index}: fitting {key}", 0.0)
        make_scene = functools.partial(
            reconstruct,
            view,
            recipe,
            lambda share: progress("", 0.5 * share / len(cameras)),
            (backgrounds or {}).get(key, []),
            others=[other for name, other in episode.views.items() if name != key],
            episode=index,
            key=key,
        )
        scenes[key] = kept.keep(f"{SCENE}_{key}", make_scene)
    drawn = {key: on_device(scene, chosen_device(recipe.device)) for key, scene in scenes.items()}
    priors = {key: scene.provenance for key, scene in scenes.items()}
    other = _other_pose(recipe, index, episode.views[cameras[0]])
    new = []
    if recipe.include_source:
        new.append(NewEpisode(index, Provenance(source.repo_id, index, SOURCE_VARIANT, recipe.seed, {}, priors)))
    for variant in range(recipe.variants):
        progress(f"episode {index}: rendering variant {variant}", 0.0)
        make_episode = functools.partial(_rendered, source, index, variant, recipe, output, drawn, other)
        new.append(kept.keep(f"variant_{variant:02d}", make_episode))
        progress("", 0.5 / recipe.variants)
    if recipe.save_scenes:
        for key, scene in scenes.items():
            saved.save(to_saved(scene, SceneSource(source.repo_id, index, key, source.fps)), output.scenes)
    return new


def _rendered(
    source: LeRobotDatasetMetadata,
    index: int,
    variant: int,
    recipe: Recipe,
    output: OutputDataset,
    scenes: Mapping[str, Reconstruction],
    other: Tensor | None,
) -> NewEpisode:
    """One new episode, rendered and encoded; nothing is rendered of one that was dropped."""
    start = time.perf_counter()
    found, gate = _accepted(scenes, recipe, index, variant, other)
    seconds = {"judging": round(time.perf_counter() - start, 1)}
    seconds |= {f"fitting {key}": round(scene.seconds, 1) for key, scene in scenes.items()}
    dropped = gate["rejected"][-1] if len(gate["rejected"]) > recipe.gate.redraws else ""
    new = _staged(source, index, variant, recipe, output, scenes, found, gate, dropped=dropped)
    return replace(new, seconds=seconds)


def to_saved(scene: Reconstruction, source: SceneSource) -> SavedScene:
    """What of a reconstruction is kept."""
    windows = tuple(result.scene for result in scene.results)
    return SavedScene(source, windows, scene.starts, scene.camera, scene.metric, scene.distance, scene.provenance)


def _accepted(
    scenes: Mapping[str, Reconstruction], recipe: Recipe, index: int, variant: int, other: Tensor | None
) -> tuple[NewCameras, dict[str, Any]]:
    """The cameras of one new episode, drawn again where they are rejected, and the gate's record."""
    rejected: list[str] = []
    for attempt in range(recipe.gate.redraws + 1):
        found = new_cameras(scenes, recipe, index, variant, attempt, other)
        views: dict[str, dict[str, Any]] = {key: {"distance_m": scene.distance} for key, scene in scenes.items()}
        why = [found.rejected] if found.rejected else []
        for key, scene in scenes.items():
            if recipe.gate.enabled:
                scores = judge(scene.windows, found.cameras[key])
                views[key]["scores"] = record(scores)
                why += [f"{key}: {reason}" for reason in reasons(scores, recipe.gate)]
        if not why:
            break
        rejected.append("; ".join(why))
        logger.warning("episode %d variant %d, draw %d: rejected: %s", index, variant, attempt, rejected[-1])
    return found, {"views": views, "rejected": rejected}


def _staged(
    source: LeRobotDatasetMetadata,
    index: int,
    variant: int,
    recipe: Recipe,
    output: OutputDataset,
    scenes: Mapping[str, Reconstruction],
    found: NewCameras,
    gate: dict[str, Any],
    *,
    dropped: str,
) -> NewEpisode:
    provenance = Provenance(
        source.repo_id,
        index,
        variant,
        recipe.seed,
        found.drawn,
        {key: scene.provenance for key, scene in scenes.items()},
        {key: camera_pose(scene.camera, found.cameras[key]) for key, scene in scenes.items()},
        gate,
    )
    if dropped:
        return NewEpisode(index, provenance, dropped=dropped)
    pictures = {key: new_pictures(scene, found.cameras[key], fill=recipe.fill) for key, scene in scenes.items()}
    masks = UnseenMasks() if recipe.masks else None
    if masks is not None:
        pictures = {key: masks.kept(key, some) for key, some in pictures.items()}
    frames = by_feature(source, pictures, depth=recipe.render_depth)
    new = output.stage(index, variant, frames, provenance)
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
    `estimate_priors`. The fit runs on the recipe's device; the result is on the host.

    Raises:
        ConfigError: the recipe demands a device that cannot be used.
    """
    parts = windows(view, recipe)
    if len(parts) > 1 and not backgrounds and recipe.scene.shared_background:

        def moving(numbers: Sequence[int], frames: Tensor) -> list[Tensor]:
            return [moving_in_few(parts[number][1], recipe, frames, episode, key) for number in numbers]

        with torch_on_one_thread():
            backgrounds = share([shrink(few_frames(part), recipe.fit.max_width) for _, part in parts], moving, recipe)
    beside = [[shrink(window, recipe.fit.max_width) for _, window in windows(other, recipe)] for other in others]
    fitted = []
    for number, (_, window) in enumerate(parts):

        def within(share: float, done: int = number) -> object:
            return progress((done + share) / len(parts))

        priors_of = functools.partial(
            estimate_priors,
            config=recipe.priors,
            camera=recipe.camera,
            others=[other[number] for other in beside],
            episode=episode,
            key=key,
            device=recipe.device,
        )
        fitted.append(_fit_window(window, recipe, within, backgrounds, priors_of))
    results, known, distances, evidence, witnesses = zip(*fitted, strict=True)
    starts = tuple(start for start, _ in parts)
    camera = concatenated([part.camera for part in evidence]).resized(view.camera.width, view.camera.height)
    metric = all(priors.metric for priors in known)
    said = merged([priors.provenance for priors in known])
    return Reconstruction(results, starts, metric, said, camera, distances[0], evidence, witnesses)


def _fit_window(
    view: View,
    recipe: Recipe,
    progress: Callable[[float], object],
    backgrounds: Sequence[SharedBackground],
    priors_of: Callable[..., Priors],
) -> tuple[FitResult, Priors, float, Evidence, Witness]:
    """A fitted scene of one window, its priors, look-at distance (m), what was recorded, and how well that is met."""
    device = chosen_device(recipe.device)
    steps, settings = recipe.fit.steps, recipe.scene
    recorded_width, view = view.rgb.shape[2], shrink(view, recipe.fit.max_width)
    ratio = recorded_width / view.rgb.shape[2]
    with torch_on_one_thread():
        shared = next((background for background in backgrounds if background.fits(view)), None)
        priors = priors_of(view, elsewhere=None if shared is None else shared.frames)
        view = replace(view, camera=priors.camera or view.camera)
        if shared is not None and not shared.fits(view):  # another camera than was assumed at first
            shared = None
        if not view.camera.is_static:
            logger.warning("the camera moves, but the empty scene is built as if it were fixed: expect blur")
        provider = priors.provenance["depth"]["provider"]
        if provider not in SHARP_DEPTH:
            settings = _for_rough_depth(settings)
        empty = empty_scene(view.rgb, priors.depth, priors.instances)
        if shared is not None:
            empty = completed(empty, shared.empty, len(view.rgb))
        distance = look_at_distance(empty.depth)
        scene = replace(initialise(view, priors, settings, recipe.motion, empty), near=NEAR * distance)
        if shared is not None and shared.static is not None:
            scene = replace(scene, static=adapted(shared, empty, scene.static))
            steps = round(FURTHER_STEPS * steps)
        result = fit(
            to_device(scene, device),
            view,
            priors,
            replace(recipe.fit, steps=steps),
            empty=empty.rgb,
            distance=distance,
            seed=recipe.seed,
            progress=lambda done: progress(done / steps),
        )
        if provider != "recorded":
            result = replace(result, scene=without_disproved(result.scene, view))
        seen = evidence_of(result.scene, view.camera, empty)
        if settings.overlay:
            overlay = unexplained(result.scene, view, priors)
            result = replace(result, scene=replace(result.scene, overlay=overlay))
        said = witness(result.scene, view, priors, result.held_out)
        result = replace(result, scene=enlarged(result.scene, view.camera, ratio))
        result, seen = to_device((result, seen), "cpu")
    return result, priors, distance, seen, said


def _for_rough_depth(scene: SceneConfig) -> SceneConfig:
    """Settings for depth that is uncertain near edges, and disagrees between frames."""
    return replace(
        scene,
        mask_border_px=max(scene.mask_border_px, ROUGH_BORDER_PX),
        moving_frames=min(scene.moving_frames, ROUGH_FRAMES),
    )


def by_feature(
    source: LeRobotDatasetMetadata, pictures: dict[str, Iterator[Picture]], *, depth: bool = True
) -> Iterator[dict[str, np.ndarray]]:
    """Per time, feature -> picture: the cameras in step, and the depth (if wanted) of those that have it recorded."""
    for together in zip(*pictures.values(), strict=True):
        features: dict[str, np.ndarray] = {}
        for key, picture in zip(pictures, together, strict=True):
            features[key] = picture.rgb
            depth_key = depth_key_of(source, key) if depth else None
            if depth_key is not None:
                features[depth_key] = picture.depth
        yield features
