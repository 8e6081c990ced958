"""A reconstructed camera seen from elsewhere: pictures and coverage, frame by frame."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int, UInt8
from torch import Tensor

from lerobot_msdyn.cameras import CameraTrack
from lerobot_msdyn.coverage import HOLE_ALPHA, Coverage, Evidence, coverage_of
from lerobot_msdyn.filling import fill_holes
from lerobot_msdyn.fitting import FitResult
from lerobot_msdyn.quality.verdict import Witnessed
from lerobot_msdyn.quality.witness import Witness
from lerobot_msdyn.rendering import Rendering, render_frames

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Reconstruction:
    """One camera's scenes, one per window of its video, and what was known about it."""

    results: tuple[FitResult, ...]
    starts: tuple[int, ...]  # first frame of each window
    metric: bool  # whether depth is in true metres
    provenance: dict[str, dict[str, str]]  # prior -> provider, why, model and licence, of the first window
    camera: CameraTrack  # at the size of the recorded video
    distance: float  # m, to the look-at point
    evidence: tuple[Evidence, ...]  # what the recorded camera showed in each window
    witnesses: tuple[Witness, ...]  # how well each window's scene explains its own video

    @property
    def windows(self) -> list[Witnessed]:
        """What a new view is judged by."""
        parts = zip(self.results, self.evidence, self.witnesses, self.starts, strict=True)
        return [Witnessed(result.scene, *rest) for result, *rest in parts]

    @property
    def seconds(self) -> float:
        """Time that was spent in fitting."""
        return sum(result.seconds for result in self.results)


@dataclass(frozen=True)
class Picture:
    """One frame of a new view."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]  # m, z-depth; 0 where nothing is known, and everywhere if there is no true scale
    unseen: Bool[np.ndarray, "h w"]  # what no frame has shown, and was filled in


def coverages(scene: Reconstruction, camera: CameraTrack, frames: Tensor | None = None) -> Iterator[Coverage]:
    """What is known about each pixel of another camera's frames; `frames` as in `new_pictures`."""
    for _, found in _drawn(scene, camera, frames):
        yield from found


def new_pictures(scene: Reconstruction, camera: CameraTrack, frames: Tensor | None = None) -> Iterator[Picture]:
    """The scene through another camera, holes filled; the share of what is unseen is logged at the end.

    `frames` (int, [t]) are those that the poses of `camera` belong to; default: all.
    """
    shares: list[float] = []
    for rendering, found in _drawn(scene, camera, frames):
        drawn = (rendering.rgb.clamp(0, 1) * 255).round().to(torch.uint8)
        for i, coverage in enumerate(found):
            alpha, depth = rendering.alpha[i].numpy(), rendering.depth[i].numpy()
            filled, _ = fill_holes(drawn[i].numpy(), alpha)
            shares.append(coverage.unseen_share)
            known = (alpha >= HOLE_ALPHA) & scene.metric
            yield Picture(filled, np.where(known, depth, np.float32(0)), coverage.unseen)
    logger.info("%.1f %% of the pixels were never seen (worst frame %.1f %%)", 100 * np.mean(shares), 100 * max(shares))


def _drawn(
    scene: Reconstruction, camera: CameraTrack, frames: Tensor | None
) -> Iterator[tuple[Rendering, list[Coverage]]]:
    """Some frames at a time through another camera, and what is known about them."""
    frames = torch.arange(len(scene.camera)) if frames is None else frames
    for window, part in _parts(scene, frames):
        result, evidence = scene.results[window], scene.evidence[window]
        times, poses = frames[part] - scene.starts[window], camera.select(part)
        done = 0
        for rendering in render_frames(result.scene, poses, times, extra=evidence.moving_frames):
            batch = slice(done, done + len(rendering.alpha))
            done = batch.stop
            yield rendering, coverage_of(rendering, poses.select(batch), times[batch], evidence)


def _parts(scene: Reconstruction, frames: Int[Tensor, " t"]) -> Iterator[tuple[int, slice]]:
    """Stretches of frames that are of the same window, in order, with the window."""
    window = torch.searchsorted(torch.tensor(scene.starts), frames, right=True) - 1
    start = 0
    for index, count in zip(
        *(values.tolist() for values in window.unique_consecutive(return_counts=True)), strict=True
    ):
        yield index, slice(start, start + count)
        start += count
