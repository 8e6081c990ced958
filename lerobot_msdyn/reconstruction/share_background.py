"""What several videos of one camera show together is fitted once, and kept on disk."""

import dataclasses
import itertools
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.core.observations import DepthTraits, PointTracks, Priors, View
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.priors import estimate_masks, estimate_priors
from lerobot_msdyn.priors.cache import code_digest, digest_of, open_cache
from lerobot_msdyn.priors.estimate import known_camera
from lerobot_msdyn.reconstruction.align_poses import keys_and_poses
from lerobot_msdyn.reconstruction.background import NEAR, look_at_distance
from lerobot_msdyn.reconstruction.fit import fit
from lerobot_msdyn.reconstruction.initialise import initialise
from lerobot_msdyn.reconstruction.key_views import fixed_view
from lerobot_msdyn.reconstruction.pooled_background import (
    MovingIn,
    SharedBackground,
    as_arrays,
    few,
    from_arrays,
    pooled,
    same_places,
)
from lerobot_msdyn.reconstruction.shown_elsewhere import Shown
from lerobot_msdyn.reconstruction.windows import Window, windows
from lerobot_msdyn.render.devices import chosen_device

logger = logging.getLogger(__name__)


def share_backgrounds(views: list[View], moving: MovingIn, recipe: Recipe) -> list[SharedBackground]:
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


def moving_in_few(whole: Window, recipe: Recipe, elsewhere: Tensor, episode: int | None, key: str | None) -> Tensor:
    """What moves in the frames that `few_frames` takes; the masks of all of them, which their fit finds cached."""
    masks = [
        estimate_masks(
            part.steady(recipe.fit.max_width),
            recipe.priors,
            recipe.camera,
            elsewhere=elsewhere,
            episode=episode,
            key=key,
            device=recipe.device,
        )
        for part in windows(whole, recipe)
    ]
    return torch.cat(masks)[few(len(whole.view))]


def shown_by(view: View, recipe: Recipe, episode: int, key: str) -> Shown | None:
    """What an episode shows to others of what stands still; None where its camera does so too, or poses are its own.

    Raises:
        PriorError: a prior was demanded and cannot be had.
    """
    small = view.shrunk(recipe.fit.max_width)
    camera = known_camera(small, recipe.priors, recipe.camera, episode=episode, key=key)
    if camera.is_static or not camera.world:
        return None
    keys = []
    for part in windows(Window(0, small), recipe):
        priors = estimate_priors(
            part.view, recipe.priors, recipe.camera, episode=episode, key=key, device=recipe.device
        )
        posed = replace(part.view, camera=priors.camera or part.view.camera)
        keys.append(keys_and_poses(posed, priors, refine=recipe.camera.refine_poses)[1])
    by_rank = itertools.zip_longest(*keys)  # the first of each window first: they show most
    return Shown.of(episode, [key_view for rank in by_rank for key_view in rank if key_view is not None])


def _fitted(background: SharedBackground, recipe: Recipe) -> SharedBackground:
    """A shared background with a static set that was fitted to its picture; without depth there is none."""
    empty, camera = background.empty, background.camera
    if not bool((empty.depth > 0).any()):
        return background
    nothing = torch.zeros(1, *empty.seen.shape, dtype=torch.uint8)
    priors = Priors(empty.depth[None], nothing, PointTracks.none(1), DepthTraits(metric=True))
    view = View(empty.rgb[None], camera)
    scene = initialise(
        view, priors, replace(recipe.scene, moving_gaussians=0), recipe.motion, fixed_view(empty, camera)
    )
    pixel_by_pixel = replace(recipe.fit.density, enabled=False)  # as `adapted` expects it
    config = replace(recipe.fit, steps=recipe.fit.steps // 2, shadows=False, held_out_frames=0, density=pixel_by_pixel)
    try:
        distance = look_at_distance(empty.depth)
        scene = replace(scene, near=NEAR * distance)
        scene = to_device(scene, chosen_device(recipe.device))
        result = fit(scene, view, priors, config, empty=empty.rgb, distance=distance, seed=recipe.seed)
    except EpisodeError as error:
        logger.warning("shared background: %s; every episode fits its own", error)
        return background
    return replace(background, static=to_device(result.scene.static, "cpu"))
