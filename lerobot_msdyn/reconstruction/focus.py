"""Most steps of a fit look only where something moves: there the moving set is compared, what stands still stays.

What stands still is the same at every frame, so that the steps between, which look at whole pictures, suffice for it.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from lerobot_msdyn.core.config import FitConfig
from lerobot_msdyn.core.images import box_about
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.sampling import scaled_window
from lerobot_msdyn.core.visibility import projected
from lerobot_msdyn.priors import Priors
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.footprints import footprints

AROUND_PX = 8  # of 320: about what moves, by mask or by motion, that is looked at as well
ONE_PIXEL = slice(0, 1), slice(0, 1)  # is rendered where there is nothing to look at
BY_PIXEL = {"rgb", "depth", "mask"}  # loss terms that leave out pixels that are not looked at


@dataclass(frozen=True)
class Look:
    """What a step looks at that does not look at a whole picture."""

    scene: DynamicScene  # what is rendered: its static set without gradients
    rows: slice  # of the picture, that are rendered ...
    columns: slice
    where: Bool[Tensor, "1 h w"]  # ... and the pixels of these that the scene shows whole


class Focus:
    """Where the steps look that do not look at whole pictures, before a fixed camera."""

    @torch.no_grad()
    def __init__(self, scene: DynamicScene, view: View, priors: Priors, device: torch.device) -> None:
        """For a scene as it is before the fit; the motion stays as it is.

        Args:
            scene: on the host, as are the others.
            view: the video.
            priors: what moves in it.
            device: of the scenes that it will be asked about.
        """
        camera = view.camera.select([0])
        # As they are at first: they hardly move.
        self._still = footprints(scene.static.means, scene.static.scales.amax(-1), camera)
        window = scaled_window(AROUND_PX, view.camera.width)
        regions = []
        for frame, instances in enumerate(priors.instances):
            moving = (instances > 0).numpy().astype(np.uint8)
            moved = projected(scene.positions(torch.tensor([frame]))[0, len(scene.static) :], camera)
            row, column = (index[moved.inside].numpy() for index in moved.pixel)
            moving[row, column] = 1
            regions.append(cv2.dilate(moving, window) > 0)
        self._crops: list[tuple[slice, slice]] = [
            box_about(region, margin=0) if region.any() else ONE_PIXEL for region in regions
        ]
        self._regions = torch.from_numpy(np.stack(regions)).to(device)
        self._shown: dict[int, Int[Tensor, " n"]] = {}  # by frame, the static Gaussians that its region may show

    @classmethod
    def wanted(cls, config: FitConfig, view: View, priors: Priors) -> bool:
        """Whether a fit can do with it: what stands still keeps its place, motion is given, losses are by pixel.

        Where depth is measured, less of a look at what stands still is seen from other cameras (0.1 to 0.2 dB).
        """
        learns = config.learn.motion or config.density.enabled
        terms = {name for name, weight in config.weights.items() if weight > 0}
        suffices = view.camera.is_static and not priors.depth_traits.measured
        return config.whole_every > 1 and suffices and not learns and terms <= BY_PIXEL

    @torch.no_grad()
    def __call__(self, scene: DynamicScene, frame: int) -> Look:
        """Where a step looks at a frame.

        On a GPU all of the scene is rendered, without waiting for what can be left out.
        """
        region, crop = self._regions[frame], self._crops[frame]
        rows: Tensor | slice = slice(None)
        if region.device.type == "cpu":
            if frame not in self._shown:
                self._shown[frame] = self._still.may_cover(region.numpy()).nonzero()[:, 0]
            rows = self._shown[frame]
        return Look(scene.select_static(rows), *crop, region[None][:, *crop])
