"""One camera's reconstruction: what new views of an episode are rendered from and judged by."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.priors.camera.stands import Stands
from lerobot_msdyn.reconstruction.account import Account, pooled
from lerobot_msdyn.reconstruction.evidence import Evidence
from lerobot_msdyn.reconstruction.self_check import SelfCheck
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.store import SavedScene, SceneSource


@dataclass(frozen=True)
class FittedWindow:
    """One window of a video: its fitted scene, and what is known about it."""

    start: int  # first frame of the window in the video
    scene: DynamicScene
    evidence: Evidence  # what the recorded camera showed
    self_check: SelfCheck  # how well the scene explains its own video
    fit_steps: int
    train_psnr_db: float  # over a few frames of the recorded camera, at the end of the fit
    seconds: Mapping[str, float]  # that each step of the reconstruction took


@dataclass(frozen=True)
class Reconstruction:
    """One camera of an episode, one fitted scene per window of its video."""

    windows: tuple[FittedWindow, ...]
    metric: bool  # whether depth is in true metres, in all windows
    provenance: dict[str, dict[str, str]]  # prior -> provider, why, model and licence, of all windows
    camera: CameraTrack  # at the size of the recorded video
    distance: float  # m, to the look-at point
    up: tuple[float, float, float]  # the vertical in the axes of the camera at the first frame
    stands: Stands  # where the camera stood

    @property
    def seconds(self) -> dict[str, float]:
        """Time that each step of the reconstruction took, over all windows."""
        total: dict[str, float] = {}
        for window in self.windows:
            for step, seconds in window.seconds.items():
                total[step] = total.get(step, 0.0) + seconds
        return total

    @property
    def account(self) -> Account:
        """What renders the moving pixels of the recorded camera, and how well, over all windows."""
        return pooled([window.self_check.account for window in self.windows])

    def without_overlay(self) -> "Reconstruction":
        """The same without the recorded pixels of single frames."""
        return self._with_scenes(lambda scene: replace(scene, overlay=None))

    def by_motion_alone(self) -> "Reconstruction":
        """The same rendered by motion and background alone."""
        return self._with_scenes(DynamicScene.without_patches)

    def _with_scenes(self, change: Callable[[DynamicScene], DynamicScene]) -> "Reconstruction":
        windows = (replace(window, scene=change(window.scene)) for window in self.windows)
        return replace(self, windows=tuple(windows))

    def stretches(self, frames: Int[Tensor, " t"]) -> Iterator[tuple[FittedWindow, slice]]:
        """Stretches of frames that are of the same window, in order, with the window."""
        starts = torch.tensor([window.start for window in self.windows])
        number = torch.searchsorted(starts, frames, right=True) - 1
        start = 0
        for index, count in zip(
            *(each.tolist() for each in number.unique_consecutive(return_counts=True)), strict=True
        ):
            yield self.windows[index], slice(start, start + count)
            start += count

    def saved(self, source: SceneSource) -> SavedScene:
        """What of it is kept for later views."""
        scenes = tuple(window.scene for window in self.windows)
        starts = tuple(window.start for window in self.windows)
        return SavedScene(source, scenes, starts, self.camera, self.metric, self.distance, self.provenance, self.up)
