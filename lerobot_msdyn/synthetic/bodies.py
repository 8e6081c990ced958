"""Clouds of tracked points with a known motion: a rigid, a slightly and a strongly deforming body."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.core.geometry import axis_angle_to_matrix

BodyKind = Literal["rigid", "weak", "deformable"]
BODY_KINDS: tuple[BodyKind, ...] = get_args(BodyKind)

_AMPLITUDE = {"rigid": 0.0, "weak": 0.12, "deformable": 1.0}  # of the deformation
_SIZE = (0.24, 0.16, 0.03)  # m
_BEND, _WAVE, _TWIST = 0.012, 0.004, 0.30  # m, m, rad: of the strongest deformation


@dataclass(frozen=True)
class TrackedBody:
    """Points of one body, where they truly are, and what a tracker would have seen of them."""

    truth: Float[Tensor, "n t 3"]  # m
    seen: Float[Tensor, "n t 3"]  # m, with noise; zero where not valid
    valid: Bool[Tensor, "n t"]


def tracked_body(
    kind: BodyKind,
    seed: int = 0,
    *,
    tracks: int = 3000,
    frames: int = 60,
    noise: float = 0.002,
    missing: float = 0.35,
) -> TrackedBody:
    """A slab of 24 x 16 x 3 cm that travels 20 cm and turns by 70 degrees, while it bends, ripples and twists.

    Args:
        kind: how much it deforms: not at all, by about a millimetre, by about a centimetre.
        seed: of the points, the noise and the gaps.
        tracks: number of points.
        frames: length of the clip.
        noise: standard deviation of a position along each axis, m.
        missing: share of the positions that are not seen, at random; besides, every second track has a gap of a
            fifth of the clip.
    """
    generator = torch.Generator().manual_seed(seed)
    body = (torch.rand(tracks, 3, generator=generator) - 0.5) * torch.tensor(_SIZE)
    time = torch.linspace(0, 1, frames)
    shape = body[:, None] + _AMPLITUDE[kind] * _deformation(body, time)
    turn = axis_angle_to_matrix((math.radians(70) * _eased(time))[:, None] * torch.tensor([0.36, 0.48, 0.8]))
    path = torch.stack((0.2 * _eased(time), 0.05 * torch.sin(math.pi * time), 0.7 + 0.06 * time), dim=-1)
    truth = (turn @ shape[..., None])[..., 0] + path
    valid = torch.rand(tracks, frames, generator=generator) >= missing
    start = torch.randint(0, frames, (tracks,), generator=generator)
    gap = (torch.arange(frames) >= start[:, None]) & (torch.arange(frames) < start[:, None] + frames // 5)
    valid &= ~(gap & (torch.arange(tracks) % 2 == 0)[:, None])
    seen = truth + noise * torch.randn(truth.shape, generator=generator)
    return TrackedBody(truth, torch.where(valid[..., None], seen, 0.0), valid)


def _eased(time: Float[Tensor, " t"]) -> Float[Tensor, " t"]:
    """0 to 1, at rest at both ends."""
    return 0.5 - 0.5 * torch.cos(math.pi * time)


def _deformation(body: Float[Tensor, "n 3"], time: Float[Tensor, " t"]) -> Float[Tensor, "n t 3"]:
    """Displacements (m) of the strongest deformation, in the frame of the body."""
    u, v = (body[:, axis, None] / (_SIZE[axis] / 2) for axis in (0, 1))
    phase = 2 * math.pi * time
    bend = _BEND * torch.sin(phase) * (u.square() - 1 / 3)
    wave = _WAVE * torch.sin(1.5 * phase) * torch.sin(1.5 * math.pi * u + phase)
    angle = _TWIST * torch.sin(0.7 * phase) * u
    across = v * _SIZE[1] / 2
    stretch = 0.02 * torch.sin(0.8 * phase) * u * (1 + v) / 2
    return torch.stack(
        (stretch.expand(-1, len(time)), across * (angle.cos() - 1), bend + wave + across * angle.sin()), dim=-1
    )
