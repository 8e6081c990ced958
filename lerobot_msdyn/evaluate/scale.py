"""Wrong scale told from wrong shape: the one factor of all depths by which a scene shows its true views best.

A scene of one fixed camera that is scaled about this camera looks the same to it. Seen from elsewhere it looks as the
scene does at its own size from the shift over the factor.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.sampling import evenly
from lerobot_msdyn.evaluate.metrics import masked_psnr_db
from lerobot_msdyn.evaluate.scores import MIN_PIXELS, NEVER, TrueViews

FARTHEST = math.log(3.0)  # factors from 1/3 to 3 are tried ...
COARSE = 13  # ... at so many places
FINE = 6  # halvings of the interval about the best
FRAMES = 2  # of each camera


@dataclass(frozen=True)
class HeldOut:
    """A camera that was not fitted, and what it truly saw."""

    camera: CameraTrack
    frames: Int[Tensor, " n"]  # of the episode, one for each of the camera's poses
    truth: TrueViews

    def some(self) -> "HeldOut":
        """A few of its views."""
        few = evenly(len(self.frames), FRAMES)
        rows = few.numpy()
        truth, moving = self.truth, self.truth.moving
        true = TrueViews(truth.rgb[rows], truth.seen[rows], None if moving is None else moving[rows])
        return HeldOut(self.camera.select(few), self.frames[few], true)


Rendered = Callable[[HeldOut, CameraTrack], UInt8[ndarray, "n h w 3"]]  # a held-out camera's views from other places


def fitted_scale(recorded: CameraTrack, held_out: Sequence[HeldOut], rendered: Rendered) -> float:
    """The factor of all depths at which the PSNR of a few views is largest, by a grid and then halving.

    Raises:
        ConfigError: the recorded camera moves, so that its own pictures hold a scale.
    """
    if not recorded.is_static:
        raise ConfigError("fit_scale is true, but the recorded camera moves; expected one that stands still")
    few = [view.some() for view in held_out]

    def score(logarithm: float) -> float:
        return float(np.mean([_psnr_db(view, recorded, math.exp(logarithm), rendered) for view in few]))

    places = np.linspace(-FARTHEST, FARTHEST, COARSE).tolist()
    known = {place: score(place) for place in places}
    step = places[1] - places[0]
    for _ in range(FINE):
        best = max(known, key=lambda place: known[place])
        step /= 2
        known |= {place: score(place) for place in (best - step, best + step)}
    return math.exp(max(known, key=lambda place: known[place]))


def at_scale(camera: CameraTrack, recorded: CameraTrack, frames: Int[Tensor, " n"], factor: float) -> CameraTrack:
    """The camera that sees of a scene as it is what another one sees of it with all depths times a factor."""
    poses, centre = camera.world_from_camera.clone(), recorded.world_from_camera[frames, :3, 3]
    poses[:, :3, 3] = centre + (poses[:, :3, 3] - centre) / factor
    return replace(camera, world_from_camera=poses)


def _psnr_db(view: HeldOut, recorded: CameraTrack, factor: float, rendered: Rendered) -> float:
    pictures = rendered(view, at_scale(view.camera, recorded, view.frames, factor))
    seen = view.truth.seen != NEVER
    enough = [i for i, mask in enumerate(seen) if mask.sum() >= MIN_PIXELS]
    return float(np.mean([masked_psnr_db(pictures[i], view.truth.rgb[i], seen[i]) for i in enough])) if enough else 0.0
