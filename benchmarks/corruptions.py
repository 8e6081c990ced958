"""Simulated episodes that are reconstructed from what is wrong: depth, masks, tracks, or a fit that stops at once."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.dataset.read import open_source, read_episode
from lerobot_msdyn.dataset.select import select_cameras
from lerobot_msdyn.priors import Priors, estimate_priors
from lerobot_msdyn.priors.exchange import from_priors, write_exchange
from lerobot_msdyn.synthetic.rough_depth import rough_depth

CORRUPTIONS = ("none", "wrong_depth", "wrong_sensor", "too_few_steps", "broken_masks", "lost_tracks")
FEW_STEPS = 1
WORSE = 2.0  # times the errors of a usual network
MASKS_LOST = 0.4  # share of the frames whose mask is empty; the others' are shifted
MASK_SHIFT = 0.03  # of the width
TRACKS_KEPT = 0.3  # share of the clip after which every track is lost


@dataclass(frozen=True)
class Case:
    """A video and the recipe by which it is reconstructed."""

    view: View
    recipe: Recipe


def read_clip(folder: Path, stride: int, width: int) -> View:
    """Every `stride`-th frame of a simulated episode with its recorded depth and true camera, at `width` px or less."""
    source = open_source(f"local/{folder.name}", folder / "dataset_depth")
    key = select_cameras(source, None)[0]
    view = read_episode(source, 0, [key], Recipe().camera).views[key]
    with np.load(folder / "gt" / "train.npz", allow_pickle=False) as truth:
        poses = torch.from_numpy(truth["c2w"]).float()
        intrinsics = torch.from_numpy(truth["K"]).float().expand(len(poses), 3, 3).contiguous()
    every = slice(0, None, stride)
    camera = CameraTrack(intrinsics, poses, view.camera.width, view.camera.height)
    return replace(view, camera=camera).select(every).shrunk(width)


def corrupted(view: View, recipe: Recipe, corruption: str, priors: Priors, folder: Path) -> Case:
    """The case of one corruption; `priors` are those of the uncorrupted video, `folder` is where files may be put."""
    rng = np.random.default_rng(0)
    path = folder / f"{corruption}.npz"
    known: dict[str, Any] = {"masks": str(path), "tracks": str(path)}
    if corruption == "wrong_depth":
        assert view.depth is not None
        priors = replace(priors, depth=torch.from_numpy(wrong_depth(view.depth.numpy(), rng)))
        known["depth"] = str(path)
    elif corruption == "wrong_sensor":  # the same depth, but as if it had been recorded: nothing says that it is poor
        assert view.depth is not None
        view = replace(view, depth=torch.from_numpy(wrong_depth(view.depth.numpy(), rng)))
    elif corruption == "too_few_steps":
        recipe = replace(recipe, fit=replace(recipe.fit, steps=FEW_STEPS))
    elif corruption == "broken_masks":
        priors = replace(priors, instances=torch.from_numpy(broken_masks(priors.instances.numpy(), rng)))
        del known["tracks"]
    elif corruption == "lost_tracks":
        visible = priors.tracks.visible.clone()
        visible[:, round(TRACKS_KEPT * visible.shape[1]) :] = False
        kept = visible.any(1)
        tracks = replace(
            priors.tracks,
            xy=priors.tracks.xy[kept],
            visible=visible[kept],
            confidence=priors.tracks.confidence[kept],
            instance=priors.tracks.instance[kept],
        )
        priors = replace(priors, tracks=tracks)
    write_exchange(path, from_priors(view, priors, 0, "front"))
    return Case(view, replace(recipe, priors=replace(recipe.priors, **known)))


def clean_priors(view: View, recipe: Recipe) -> Priors:
    """Those that a video has when nothing is wrong."""
    return estimate_priors(view, recipe.priors, recipe.camera)


def wrong_depth(depth: Float[ndarray, "t h w"], rng: np.random.Generator) -> Float[ndarray, "t h w"]:
    """Depth (m) as a poor network would give it."""
    return rough_depth(depth, rng, worse=WORSE)


def broken_masks(instances: ndarray, rng: np.random.Generator) -> ndarray:
    """Instances (uint8 [t,h,w]) that are empty in some frames and shifted in all others."""
    found = np.zeros_like(instances)
    reach = round(MASK_SHIFT * instances.shape[2])
    for frame, mask in enumerate(instances):
        if rng.random() >= MASKS_LOST:
            angle = rng.uniform(0, 2 * np.pi)
            shift = (round(reach * np.sin(angle)), round(reach * np.cos(angle)))
            found[frame] = np.roll(mask, shift, axis=(0, 1))
    return found
