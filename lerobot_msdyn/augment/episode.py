"""One source episode becomes its new ones: reconstructed, seen from new cameras, judged, encoded, staged."""

import functools
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_msdyn.augment.asked import no_other_camera
from lerobot_msdyn.augment.backgrounds import Backgrounds
from lerobot_msdyn.augment.earlier_scenes import earlier_scene
from lerobot_msdyn.augment.recorded import read_recorded
from lerobot_msdyn.augment.shown import steps_with_sheet, write_frame
from lerobot_msdyn.core.config import GateConfig, Recipe
from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.dataset.calibration import read_calibration
from lerobot_msdyn.dataset.pose_columns import ORIGIN, new_poses
from lerobot_msdyn.dataset.provenance import SOURCE_VARIANT, Provenance, camera_pose
from lerobot_msdyn.dataset.read import depth_key_of, read_colour
from lerobot_msdyn.dataset.rows import read_rows
from lerobot_msdyn.dataset.staging import SCENE
from lerobot_msdyn.dataset.write import NewEpisode, OutputDataset
from lerobot_msdyn.priors.camera.path import displacement_px
from lerobot_msdyn.reconstruction.account import account_line
from lerobot_msdyn.reconstruction.on_disk import save_reconstruction
from lerobot_msdyn.reconstruction.reconstruct import reconstruct
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.render.devices import chosen_device
from lerobot_msdyn.scene.store import SceneSource
from lerobot_msdyn.views.flashes import Flash, Flashes, largest_flash, too_large
from lerobot_msdyn.views.gate import judge, reasons, record, video_reasons
from lerobot_msdyn.views.new_cameras import NewCameras, new_cameras
from lerobot_msdyn.views.pictures import Picture, UnseenMasks, for_many_views, log_uncovered, new_pictures

logger = logging.getLogger(__name__)

Progress = Callable[[str, float], object]  # (what is being done, share of the episode done since the last call)


class Noted(NamedTuple):
    """What is wrong with one camera's recording of an episode."""

    defects: list[str]  # of its pictures, in words
    displaced_px: float | None  # of 320: how far it begins from where it did in episode 0; None: unknown
    flash: Flash  # its largest


def augment_episode(
    source: LeRobotDatasetMetadata,
    index: int,
    cameras: list[str],
    recipe: Recipe,
    output: OutputDataset,
    progress: Progress = lambda what, share: None,
    backgrounds: Backgrounds | None = None,
) -> list[NewEpisode]:
    """All new episodes of one source episode, staged in the output; `backgrounds` come from `seen_together`.

    What an earlier run has finished of it is taken from the output's work folder.

    Raises:
        EpisodeError: the episode cannot be read or reconstructed.
        PriorError: a prior was demanded and cannot be had.
    """
    episode, defects = read_recorded(source, index, cameras, recipe)
    noted = {}
    for key, found in defects.items():
        view = episode.views[key]
        noted[key] = Noted(found.lines(), _displaced_px(source, key, view), largest_flash(view.rgb.numpy()))
        if noted[key].defects:
            logger.warning("%s episode %d, %s: %s", source.repo_id, index, key, "; ".join(noted[key].defects))
    other = _other_pose(recipe, index, episode.views[cameras[0]]) if cameras else None
    kept = output.episode(index)
    scenes, sheets = {}, {}
    for key, view in episode.views.items():
        if recipe.scenes is not None:
            scenes[key] = earlier_scene(recipe.scenes, index, key)
            continue
        progress(f"episode {index}: fitting {key}", 0.0)
        sheets[key] = kept.folder / f"priors_{key}.jpg"
        make_scene = functools.partial(
            reconstruct,
            view,
            recipe,
            lambda share: progress("", 0.5 * share / len(cameras)),
            (backgrounds or {}).get(key, []),
            others=[other for name, other in episode.views.items() if name != key],
            episode=index,
            key=key,
            steps=steps_with_sheet(sheets[key], key, source.fps),
        )
        try:
            scenes[key] = kept.keep(f"{SCENE}_{key}", make_scene)
        except EpisodeError as error:
            raise EpisodeError(f"{source.repo_id} episode {index}, {key}: {error}") from error
    ready = {key: for_many_views(scene, chosen_device(recipe.device)) for key, scene in scenes.items()}
    priors = {key: scene.provenance for key, scene in scenes.items()}
    new = []
    if recipe.include_source:
        known = {key: scene.camera for key, scene in scenes.items() if scene.camera.world}
        poses = {key: camera_pose(camera, camera) for key, camera in known.items()}
        new.append(NewEpisode(index, Provenance(source.repo_id, index, SOURCE_VARIANT, recipe.seed, {}, priors, poses)))
    for variant in range(recipe.variants if cameras else 0):
        progress(f"episode {index}: rendering variant {variant}", 0.0)
        make_episode = functools.partial(_rendered, source, index, variant, recipe, output, ready, noted, other)
        new.append(replace(kept.keep(f"variant_{variant:02d}", make_episode), sheets=sheets))
        progress("", 0.5 / recipe.variants)
    if recipe.save_scenes:
        for key, scene in scenes.items():
            save_reconstruction(scene, SceneSource(source.repo_id, index, key, source.fps), output.scenes)
    for key, scene in scenes.items():
        logger.info("episode %d, %s: %s", index, key, account_line(scene.account))
    return new


def _rendered(
    source: LeRobotDatasetMetadata,
    index: int,
    variant: int,
    recipe: Recipe,
    output: OutputDataset,
    scenes: Mapping[str, Reconstruction],
    noted: Mapping[str, Noted],
    other: Tensor | None,
) -> NewEpisode:
    """One new episode, rendered and encoded; of one that is dropped a single frame is kept, for the report."""
    start = time.perf_counter()
    chosen, gate, dropped = _accepted(scenes, recipe, index, variant, other)
    for key, view in gate["views"].items():
        view["camera"] = scenes[key].stands.entry() | {"displaced_px": noted[key].displaced_px}
        if not scenes[key].camera.is_static:
            view["camera"] |= {"stands": False, "path_m": round(scenes[key].camera.path_length, 3)}
        view["defects"] = noted[key].defects
    seconds = {"judging": round(time.perf_counter() - start, 1)}
    seconds |= {f"fitting {key}": round(scene.seconds["fit"], 1) for key, scene in scenes.items()}
    flashes = Flashes()
    new = _staged(source, index, variant, recipe, output, scenes, chosen, gate, flashes, dropped=dropped)
    if recipe.gate.enabled and not dropped:
        new = _without_flashes(new, flashes, noted, recipe.gate)
    frames = {}
    if new.dropped:
        frames = {key: output.episode(index).folder / f"dropped_{variant:02d}_{key}.jpg" for key in scenes}
        for key, path in frames.items():
            write_frame(path, scenes[key], chosen.cameras[key], recipe.fill)
    return replace(new, seconds=seconds, frames=frames)


def _without_flashes(new: NewEpisode, flashes: Flashes, noted: Mapping[str, Noted], config: GateConfig) -> NewEpisode:
    """The same, or a dropped one where a frame flashes."""
    views, why = {}, []
    for key, view in new.provenance.gate["views"].items():
        largest = flashes.largest(key)
        views[key] = view | {"flash": largest.entry()}
        reason = too_large(largest, noted[key].flash, config)
        why += [f"{key}: {reason}"] if reason else []
    dropped = "; ".join(why)
    rejected = new.provenance.gate["rejected"] + ([dropped] if dropped else [])
    provenance = replace(new.provenance, gate={"views": views, "rejected": rejected})
    if dropped:
        logger.warning("episode %d variant %d: dropped: %s", new.source_index, provenance.variant, dropped)
        return NewEpisode(new.source_index, provenance, dropped=dropped)
    return replace(new, provenance=provenance)


def _accepted(
    scenes: Mapping[str, Reconstruction], recipe: Recipe, index: int, variant: int, other: Tensor | None
) -> tuple[NewCameras, dict[str, Any], str]:
    """The cameras of one new episode, sampled again where they are rejected, the gate's record, and why it is dropped.

    Where a recorded camera moves, or goes too fast, no other sample is better.
    """
    rejected: list[str] = []
    moving = [f"{key}: {scene.stands.reason()}" for key, scene in scenes.items() if scene.stands.moves]
    if not recipe.gate.enabled or recipe.allow_moving:
        moving = []
    if recipe.gate.enabled:
        for key, scene in scenes.items():
            moving += [f"{key}: {reason}" for reason in video_reasons(scene.windows, recipe.gate)]
    for attempt in range(1 if moving else recipe.gate.redraws + 1):
        chosen = new_cameras(scenes, recipe, index, variant, attempt, other)
        views: dict[str, dict[str, Any]] = {
            key: {"distance_m": scene.distance, "what_moves": scene.account.entry()} for key, scene in scenes.items()
        }
        why = moving + ([chosen.rejected] if chosen.rejected else [])
        for key, scene in scenes.items():
            if recipe.gate.enabled:
                scores = judge(scene.windows, chosen.cameras[key])
                views[key]["scores"] = record(scores)
                why += [f"{key}: {reason}" for reason in reasons(scores, recipe.gate)]
        if not why:
            return chosen, {"views": views, "rejected": rejected}, ""
        rejected.append("; ".join(why))
        logger.warning("episode %d variant %d, sample %d: rejected: %s", index, variant, attempt, rejected[-1])
    return chosen, {"views": views, "rejected": rejected}, rejected[-1]


def _displaced_px(source: LeRobotDatasetMetadata, key: str, view: View) -> float | None:
    """By how much a camera's first frame is displaced against that of the dataset (px of 320); None: unknown."""
    try:
        first = read_colour(source, 0, key, read_rows(source, 0), [0])[0]
    except EpisodeError:
        return None
    found = displacement_px(first, view.rgb[0])
    return None if found is None else round(found, 1)


def _staged(
    source: LeRobotDatasetMetadata,
    index: int,
    variant: int,
    recipe: Recipe,
    output: OutputDataset,
    scenes: Mapping[str, Reconstruction],
    chosen: NewCameras,
    gate: dict[str, Any],
    flashes: Flashes,
    *,
    dropped: str,
) -> NewEpisode:
    provenance = Provenance(
        source.repo_id,
        index,
        variant,
        recipe.seed,
        chosen.amounts,
        {key: scene.provenance for key, scene in scenes.items()},
        {key: camera_pose(scene.camera, chosen.cameras[key]) for key, scene in scenes.items()},
        gate,
    )
    if dropped:
        return NewEpisode(index, provenance, dropped=dropped)
    pictures = {
        key: log_uncovered(new_pictures(scene, chosen.cameras[key], fill=recipe.fill)) for key, scene in scenes.items()
    }
    pictures = {key: flashes.kept(key, frames) for key, frames in pictures.items()}
    masks = UnseenMasks() if recipe.masks else None
    if masks is not None:
        pictures = {key: masks.kept(key, frames) for key, frames in pictures.items()}
    frames = by_feature(source, pictures, depth=recipe.render_depth)
    new = output.stage(index, variant, frames, provenance)
    displaced = {key: chosen.cameras[key] for key, scene in scenes.items() if scene.camera.origin == ORIGIN}
    new = replace(new, columns=new_poses(source, index, recipe.camera, displaced))
    return new if masks is None else replace(new, masks=masks.arrays())


def _other_pose(recipe: Recipe, index: int, view: View) -> Tensor | None:
    """World from the other camera whose pose the perturbation needs, if it needs one."""
    name = recipe.perturbation.needs_pose_of
    if name is None:
        return None
    camera = None
    if recipe.camera.calibration is not None:
        height, width = view.rgb.shape[1:3]
        camera = read_calibration(recipe.camera.calibration, name, index, 1, width, height)
    if camera is None:
        raise no_other_camera(recipe)
    return camera.world_from_camera[0]


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
