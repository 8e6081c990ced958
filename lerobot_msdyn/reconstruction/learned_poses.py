"""A moving camera's poses as part of the fit: a small turn and shift of each frame's, in its own axes.

The rasterizers' gradients reach the poses. Corrections are drawn to none, and to those of the frames before and after;
frames that are not fitted have what lies between those of their neighbours.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import LearningRates
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, se3
from lerobot_msdyn.core.serialise import to_device

TRUST = 0.01  # standard deviation of the given poses: rad, and share of the look-at distance
BEND = 0.01  # of a correction from the mean of those before and after, likewise
WEIGHT = 1e-2  # of both against the other terms of the loss


class LearnedPoses:
    """Corrections of a camera's poses, as leaves for Adam."""

    def __init__(
        self,
        camera: CameraTrack,
        held_out: Int[Tensor, " n"],
        rates: LearningRates,
        distance: float,
        device: torch.device,
    ) -> None:
        """None at first.

        Args:
            camera: with the poses that are given.
            held_out: frames that are not fitted.
            rates: of turns, and of shifts in units of the distance.
            distance: m, to the look-at point.
            device: of the leaves.
        """
        self._given, self._distance, self._rates = to_device(camera, device), distance, rates
        self._between = _between(len(camera), held_out).to(device)
        fitted = self._between.shape[1]
        self._turns, self._shifts = (torch.zeros(fitted, 3, device=device, requires_grad=True) for _ in range(2))

    @property
    def groups(self) -> list[dict[str, Any]]:
        """The leaves for Adam, with their rates."""
        return [
            {"params": [self._turns], "lr": self._rates.pose_turns},
            {"params": [self._shifts], "lr": self._rates.pose_shifts * self._distance},
        ]

    @property
    def camera(self) -> CameraTrack:
        """The camera with the poses as they are, with gradients."""
        by = se3(axis_angle_to_matrix(self._between @ self._turns), self._between @ self._shifts)
        return replace(self._given, world_from_camera=self._given.world_from_camera @ by)

    @torch.no_grad()
    def result(self) -> CameraTrack:
        """The same without gradients, on the host."""
        return to_device(self.camera, "cpu")

    def loss(self) -> Float[Tensor, ""]:
        """How unlikely the corrections are: mean squares, in units of what is usual."""
        by = torch.cat((self._turns, self._shifts / self._distance), dim=1)
        away = by.square().mean() / TRUST**2
        if len(by) > 2:
            away = away + (by[1:-1] - (by[:-2] + by[2:]) / 2).square().mean() / BEND**2
        return WEIGHT * away


def _between(frames: int, held_out: Int[Tensor, " n"]) -> Float[Tensor, "t f"]:
    """What each fitted frame's correction counts at each frame: linear in time, the ends are held."""
    fitted = np.setdiff1d(np.arange(frames), held_out.numpy())
    counts = [np.interp(np.arange(frames), fitted, row) for row in np.eye(len(fitted))]
    return torch.from_numpy(np.stack(counts, axis=1)).float()
