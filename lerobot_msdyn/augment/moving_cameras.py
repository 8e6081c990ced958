"""Cameras that do not stand still, on the robot or in a hand, are told from the others by their pictures."""

import itertools
import logging
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from lerobot.datasets import LeRobotDatasetMetadata
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.augment.recorded import read_recorded
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import DatasetError, EpisodeError
from lerobot_msdyn.core.sampling import evenly, scaled_px
from lerobot_msdyn.dataset.read import Episode, hand_on
from lerobot_msdyn.dataset.select import is_wrist_camera
from lerobot_msdyn.priors.camera.steadiness import SWAY_PX, camera_motion_px
from lerobot_msdyn.priors.defects import Defects
from lerobot_msdyn.reconstruction.windows import seen_stands

logger = logging.getLogger(__name__)

CORRELATED = 0.4  # of the picture's motion with the robot's
EVEN = 0.1  # relative spread of the picture's speed up to which it moves evenly: nothing to correlate
MIN_PAIRS = 8
SMALL_PX = 160  # width at which pictures are compared


def still_cameras(
    source: LeRobotDatasetMetadata, episodes: Sequence[int], cameras: list[str], recipe: Recipe
) -> list[str]:
    """Those of the cameras that stand still, judged by the first episode that can be read.

    The others are copied as they are, with the reason.

    Raises:
        DatasetError: one that the recipe names moves, or no camera is left and recorded episodes are not asked for.
        EpisodeError: none of the episodes can be read.
    """
    episode, defects = _first_readable(source, episodes, cameras, recipe)
    moving = {key: reason for key in cameras if (reason := why_moving(episode, key, recipe.priors.cache))}
    refused = recipe.cameras is not None or (len(moving) == len(cameras) and not recipe.include_source)
    for key, reason in moving.items():
        message = f"{source.repo_id}: {key} is {'refused' if refused else 'copied'}: {reason}"
        message += " (--allow_moving true re-renders it all the same)"
        if refused:
            raise DatasetError(message)
        logger.warning(message)
    still = [key for key in cameras if key not in moving]
    for key in still:
        if not defects[key].unusable:  # else these are not its frames as recorded
            hand_on(source, episode.source.index, key, episode.views[key].rgb)
    return still


def cameras_off_the_gripper(source: LeRobotDatasetMetadata, cameras: list[str], recipe: Recipe) -> list[str]:
    """Those of the cameras that do not ride on the gripper, by their names; the others are copied as they are.

    A displaced picture of these is one of another state: the action that was recorded does not lead on from it, and no
    rule here makes another one (as SPARTN and DMD do for policies that act in the gripper's own frame).

    Raises:
        DatasetError: the recipe names one, or no camera is left and recorded episodes are not asked for.
    """
    on_gripper = [key for key in cameras if is_wrist_camera(key)]
    refused = recipe.cameras is not None or (len(on_gripper) == len(cameras) and not recipe.include_source)
    for key in on_gripper:
        message = (
            f"{source.repo_id}: {key} is {'refused' if refused else 'copied'}, also with --allow_moving: it rides on "
            "the gripper, by its name; a displaced view would be one of another state, to which the recorded actions "
            "do not belong"
        )
        if refused:
            raise DatasetError(f"{message}; leave it out of --cameras")
        logger.warning(message)
    return [key for key in cameras if key not in on_gripper]


def _first_readable(
    source: LeRobotDatasetMetadata, episodes: Sequence[int], cameras: list[str], recipe: Recipe
) -> tuple[Episode, dict[str, Defects]]:
    """The first of some episodes that can be read, and its defects; the others are reported when it is their turn."""
    errors = []
    for index in episodes:
        try:
            return read_recorded(source, index, cameras, recipe, recorded_depth=False)
        except EpisodeError as error:
            errors.append(error)
    raise EpisodeError(
        f"{source.repo_id}: none of {len(episodes)} episodes can be read, so nothing tells which cameras move with the "
        f"robot, and there is nothing to augment. First: {errors[0]}"
    )


def why_moving(episode: Episode, key: str, cache: str) -> str:
    """Why a camera is not taken to stand still; empty if it is.

    Its background goes far from where it was in the first frame, whatever the robot does; or it moves by more than a
    camera on a stand sways, and the whole picture when the robot does. `cache` is the one of the recipe's priors.
    """
    rgb = episode.views[key].rgb
    stands = seen_stands(rgb, cache)
    if stands.moves:
        return stands.reason()
    motion = camera_motion_px(rgb) / scaled_px(1, rgb.shape[2])
    if motion <= SWAY_PX:
        return ""
    if episode.state is None:
        return f"its background moves by {motion:.1f} px (of 320), and no state says whether with the robot"
    together = correlation(episode.state, rgb)
    if together < CORRELATED:
        return ""
    return f"its background moves by {motion:.1f} px (of 320) with the robot (correlation {together:.2f})"


def correlation(state: Float[Tensor, "t s"], rgb: UInt8[Tensor, "t h w 3"]) -> float:
    """How much the speed of the whole picture (phase correlation) goes with that of the state, -1..1; 0: unknown."""
    pairs = min(len(rgb) - 1, 60)
    if pairs < MIN_PAIRS:
        return 0.0
    frames = evenly(len(rgb), pairs + 1).numpy()
    spread = state.std(0).clamp(min=1e-6)
    speed = (state[frames[1:]] - state[frames[:-1]]).div(spread).norm(dim=1).numpy()
    small = [_small(rgb[int(frame)]) for frame in frames]
    window = cv2.createHanningWindow(small[0].shape[::-1], cv2.CV_32F)
    shift = np.array([np.hypot(*cv2.phaseCorrelate(a, b, window)[0]) for a, b in itertools.pairwise(small)])
    if speed.std() < 1e-6 or shift.std() <= EVEN * shift.mean():
        return 0.0
    return float(np.corrcoef(speed, shift)[0, 1])


def _small(image: UInt8[Tensor, "h w 3"]) -> ndarray:
    grey = cv2.cvtColor(image.numpy(), cv2.COLOR_RGB2GRAY).astype(np.float32)
    height = max(1, round(grey.shape[0] * SMALL_PX / grey.shape[1]))
    return cv2.resize(grey, (SMALL_PX, height), interpolation=cv2.INTER_AREA)
