"""What the recorded camera shows and the scene does not explain is shown as it was recorded, frame by frame."""

import logging
from collections.abc import Collection

import torch

from lerobot_msdyn.core.observations import View
from lerobot_msdyn.priors import Priors
from lerobot_msdyn.reconstruction.unexplained import Comparison
from lerobot_msdyn.render.cpu.threads import each_on
from lerobot_msdyn.scene.dynamic import DynamicScene, patched
from lerobot_msdyn.scene.overlay import FramePatch, Overlay, packed

logger = logging.getLogger(__name__)


def overlay_of(
    scene: DynamicScene, view: View, priors: Priors, backend: str = "auto", *, explained: Collection[int] = ()
) -> Overlay:
    """The patches of all frames that make the recorded camera see what it recorded (docs/reconstruction.md, "Overlay").

    A pixel is unexplained where the rendered picture has another colour or depth than the recorded one. There the
    frame's own pixels are put at their recorded depth, for this frame alone, and Gaussians of the scene in front of
    that surface or on it are not rendered. What lies behind it stays, and is seen past its edges from other cameras.
    Depth only contradicts the scene beyond what its provider may err by, and not at all where it is assumed.

    Args:
        scene: fitted, without an overlay; on any device, the result is on the host.
        view: the video, at the size at which it was fitted.
        priors: its depth.
        backend: of the rasterizer.
        explained: frames at which nothing is left to be shown.
    """
    comparison = Comparison(scene, view, priors, backend)

    def patch_of(frame: int) -> FramePatch:
        short = scene.short_lived_patch(frame)
        if frame in explained:
            return _nothing(len(scene.static) + len(scene.moving) + (0 if short is None else len(short)))
        snapshot = comparison.snapshot(frame)
        if short is not None:
            snapshot = patched(snapshot, short)
        wrong = comparison.wrong(snapshot, frame)
        return comparison.patch(snapshot, frame, wrong, comparison.taken(wrong, frame))

    frames = range(len(view.rgb))
    overlay = packed([*each_on(scene.device, patch_of, frames)])
    percent = 100 * len(overlay.means) / max(priors.depth.numel(), 1)
    logger.info("overlay: %.1f %% of all pixels are not explained and shown as recorded", percent)
    return overlay


def _nothing(gaussians: int) -> FramePatch:
    """A patch that shows nothing, and hides none of so many."""
    none = torch.zeros(0, 3)
    return FramePatch(none, torch.zeros(0, 4), none, none, torch.zeros(gaussians, dtype=torch.bool))
