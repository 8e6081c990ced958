"""One camera of a calibrated rig is fitted, what another one saw is rendered and compared."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, UInt8
from numpy import ndarray

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.dataset.read import Episode, open_source, read_episode
from lerobot_msdyn.evaluate.asked import chosen_cameras
from lerobot_msdyn.evaluate.colour import fit_colours
from lerobot_msdyn.evaluate.config import HeldoutCameraConfig
from lerobot_msdyn.evaluate.perceptual import SpatialNetwork, lpips_network, without_flip, without_lpips
from lerobot_msdyn.evaluate.scores import (
    NEVER,
    SEEN,
    Evaluated,
    Scores,
    TrueViews,
    score_table,
    score_views,
    source_shares,
)
from lerobot_msdyn.evaluate.timing import timed, timed_reconstruction
from lerobot_msdyn.evaluate.warp import warped
from lerobot_msdyn.priors import estimate_masks
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.views.pictures import new_pictures

FIT, SCORED = slice(0, None, 2), slice(1, None, 2)  # frames that colours are fitted to, and those that are scored
BLACK = 20  # of 0..255: what the codec makes of black stays below
BORDER_PX = 2  # beside black, where resampling mixes with it

Pictures = UInt8[ndarray, "n h w 3"]


def evaluate_heldout(config: HeldoutCameraConfig) -> Evaluated:
    """Fit one camera, render the view of another to `out`, and score every second frame of it.

    The test camera's pictures serve nothing but the comparison: they take no part in depth, and its colours are fitted
    to the other half of the frames. The further cameras that are calibrated help to measure depth, as ever.

    Raises:
        DatasetError: there is no such dataset, episode or camera.
        ConfigError: both cameras are the same, or the calibration does not name one.
    """
    seconds: dict[str, float] = {}
    with timed(seconds, "read"):
        source = open_source(config.repo_id, config.root)
        train, test, helpers = chosen_cameras(source, config)
        episode = read_episode(source, config.episode, [train, test, *helpers], config.camera)
        _check_calibrated(episode, train, test, config)
    view, held_out = episode.views[train], episode.views[test]
    scene = timed_reconstruction(seconds, view, config, others=[episode.views[key] for key in helpers])
    with timed(seconds, "render"):
        rendered, covered = _rendered(scene, held_out.camera, config.out)
    with timed(seconds, "baselines"):
        alone = np.stack([picture.rgb for picture in new_pictures(scene.without_overlay(), held_out.camera)])
        shown = {"this fit": rendered, "this fit without overlay": alone, "recorded picture": _resized(view, held_out)}
        if scene.metric:
            shown["depth warp"] = _warped(scene, view, held_out.camera)
    with timed(seconds, "score"):
        moving = estimate_masks(held_out, config.priors, config.camera, episode=config.episode, key=test).numpy() > 0
        covered &= shows_something(held_out.rgb.numpy())
        truth = TrueViews(held_out.rgb.numpy(), np.where(covered, SEEN, NEVER).astype(np.uint8), moving)
        lpips = None if without_lpips(config.lpips_weights) else lpips_network(config.lpips_weights)
        rows = {name: score_half(pictures, truth, lpips) for name, pictures in shown.items()}
        rows["this fit"] |= source_shares(scene, held_out.camera, torch.arange(len(rendered)), truth)
    notices = [
        without_flip(),
        without_lpips(config.lpips_weights),
        "" if scene.metric else "no depth warp: the depth is not metric, nor is the fit's place",
    ]
    content: dict[str, Any] = {"train_camera": train, "test_camera": test, "depth_from": helpers, "rows": rows}
    content |= {"what_moves": scene.account.entry()}
    content |= {"depth": scene.provenance["depth"], "covered": float(covered.mean()), "pictures": len(rendered)}
    content |= {"seconds": seconds, "notices": [notice for notice in notices if notice]}
    table = score_table(rows, f"{train} -> {test}, {100 * covered.mean():.0f} % covered")
    return Evaluated(content, table, config.out).written()


def _check_calibrated(episode: Episode, train: str, test: str, config: HeldoutCameraConfig) -> None:
    for key in (train, test):
        if episode.views[key].camera.origin != "calibration":
            raise ConfigError(
                f"{config.camera.calibration} does not name {key} for episode {episode.source.index}; expected K, R "
                "and t of both cameras, see docs/calibration.md"
            )


def _rendered(scene: Reconstruction, camera: CameraTrack, out: Path) -> tuple[Pictures, Bool[ndarray, "n h w"]]:
    """The scene through the held-out camera, written to `out`, and where the fitted camera has seen it."""
    out.mkdir(parents=True, exist_ok=True)
    pictures, covered = [], []
    for frame, picture in enumerate(new_pictures(scene, camera)):
        cv2.imwrite(str(out / f"rgb_{frame:04d}.png"), picture.rgb[..., ::-1])
        pictures.append(picture.rgb)
        covered.append(~picture.unseen)
    return np.stack(pictures), np.stack(covered)


def shows_something(rgb: Pictures) -> Bool[ndarray, "h w"]:
    """Pixels that are not black throughout, as the border of an undistorted picture is, nor beside such pixels."""
    lit = (rgb.max((0, 3)) > BLACK).astype(np.uint8)
    return cv2.erode(lit, np.ones((2 * BORDER_PX + 1,) * 2, np.uint8)) > 0


def _resized(view: View, like: View) -> Pictures:
    """The fitted camera's own pictures, at the size of the held-out one's."""
    size = (like.camera.width, like.camera.height)
    return np.stack([cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in view.rgb.numpy()])


def _warped(scene: Reconstruction, view: View, camera: CameraTrack) -> Pictures:
    """The recorded pictures through the held-out camera, by the depth that the scene has there."""
    pictures = []
    for frame, picture in enumerate(new_pictures(scene, scene.camera)):
        recorded, place = scene.camera.select([frame]), camera.select([frame])
        pictures.append(warped(view.rgb[frame].numpy(), picture.depth, recorded, place))
    return np.stack(pictures)


def score_half(rendered: Pictures, truth: TrueViews, lpips: SpatialNetwork | None = None) -> Scores:
    """Scores of the one half of the frames, in colours fitted to the other half."""
    colours = fit_colours(rendered[FIT], truth.rgb[FIT], truth.seen[FIT] != NEVER)
    scored = TrueViews(truth.rgb[SCORED], truth.seen[SCORED], None if truth.moving is None else truth.moving[SCORED])
    return score_views(colours.apply(rendered[SCORED]), scored, lpips)
