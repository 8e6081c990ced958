"""A deformation field: a small network that says how a canonical point has moved (Deformable 3D Gaussians' model).

A motion level of its own: `--plugins benchmarks/rivals/field.py --motion.levels '[field]'`.
"""

import math
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.geometry import quaternion_multiply
from lerobot_msdyn.core.registries import MOTION_LEVELS
from lerobot_msdyn.motion.spec import Binding, FirstLevel, PartTracks

_POINT_OCTAVES = 6  # frequencies that encode a position ...
_TIME_OCTAVES = 6  # ... and a time (Deformable 3D Gaussians, section 3.2)
_HIDDEN = 64
_LAYERS = 3
_STEPS = 1500
_BATCH = 4096  # observations a step
_RATE, _FINAL_RATE = 5e-3, 0.02  # of Adam, and the share of it that is left at the end
_HUBER = 0.02  # of the extent: larger misses count linearly


@dataclass(frozen=True)
class DeformationField:
    """(x, t) -> displacement and turn, for all points alike: nothing ties a point to an object."""

    kind: ClassVar[str] = "field"

    first: Float[Tensor, "f h"]
    hidden: Float[Tensor, "l h h"]
    biases: Float[Tensor, "m h"]  # of the first and the hidden layers
    last: Float[Tensor, "h 7"]  # displacement in units of the extent, and the turn as a quaternion less (1, 0, 0, 0)
    centre: Float[Tensor, "3"]  # m, of the canonical points
    extent: Float[Tensor, ""]  # m, half their range
    duration: Float[Tensor, ""]  # frames

    def carry(
        self,
        positions: Float[Tensor, "b n 3"],
        orientations: Float[Tensor, "b n 4"],
        indices: Int[Tensor, "n j"],
        logits: Float[Tensor, "n j"],
        times: Float[Tensor, " b"] | Int[Tensor, " b"],
    ) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 4"]]:
        """Positions (m) and orientations (wxyz) moved by the field at the times of the batch; no bases are named."""
        moved = self._at(positions, times)
        turn = torch.nn.functional.normalize(moved[..., 3:] + moved.new_tensor([1.0, 0.0, 0.0, 0.0]), dim=-1)
        return positions + self.extent * moved[..., :3], quaternion_multiply(turn, orientations)

    def carry_points(
        self,
        positions: Float[Tensor, "b n 3"],
        indices: Int[Tensor, "n j"],
        logits: Float[Tensor, "n j"],
        times: Float[Tensor, " b"] | Int[Tensor, " b"],
    ) -> Float[Tensor, "b n 3"]:
        """Positions (m) as `carry` moves them."""
        return positions + self.extent * self._at(positions, times)[..., :3]

    def _at(self, positions: Float[Tensor, "b n 3"], times: Tensor) -> Float[Tensor, "b n 7"]:
        return self(positions, times.to(positions)[:, None].expand(positions.shape[:2]))

    def __call__(self, positions: Float[Tensor, "*n 3"], times: Float[Tensor, " *n"]) -> Float[Tensor, "*n 7"]:
        """Output of the network at canonical positions (m) and times (frames)."""
        place = (positions - self.centre) / self.extent
        x = torch.cat((_encoded(place, _POINT_OCTAVES), _encoded(times[..., None] / self.duration, _TIME_OCTAVES)), -1)
        for weight, bias in zip((self.first, *self.hidden), self.biases, strict=True):
            x = (x @ weight + bias).relu()
        return x @ self.last


@MOTION_LEVELS.register("field")
class Field(FirstLevel):
    """One network for the whole scene."""

    value = DeformationField

    def estimate(self, tracks: PartTracks, config: MotionConfig) -> DeformationField:
        """Fitted to the tracks."""
        return fit_field(tracks.points, tracks.xyz, tracks.weights)

    def bind(
        self, level: DeformationField, points: Float[Tensor, "n 3"], part: Int[Tensor, " n"], coarser: Binding | None
    ) -> Binding:
        """There are no bases to follow."""
        return torch.zeros(len(points), 0, dtype=torch.long), torch.zeros(len(points), 0)


def fit_field(
    points: Float[Tensor, "n 3"],
    xyz: Float[Tensor, "n t 3"],
    weights: Float[Tensor, "n t"],
    *,
    steps: int = _STEPS,
    seed: int = 0,
) -> DeformationField:
    """A field fitted by Adam to tracks: canonical points (m) and where they were seen (m; weight 0 = not seen)."""
    generator = torch.Generator().manual_seed(seed)
    field = _untrained(points, xyz.shape[1], generator)
    learned = ("first", "hidden", "biases", "last")
    field = replace(field, **{name: getattr(field, name).requires_grad_() for name in learned})
    optimizer = torch.optim.Adam([getattr(field, name) for name in learned], lr=_RATE)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, _FINAL_RATE ** (1 / max(steps, 1)))
    track, time = (weights > 0).nonzero(as_tuple=True)
    for _ in range(steps if len(track) else 0):
        batch = torch.randint(len(track), (min(_BATCH, len(track)),), generator=generator)
        n, t = track[batch], time[batch]
        moved = points[n] + field.extent * field(points[n], t.to(points))[..., :3]
        miss = torch.nn.functional.huber_loss(
            moved / field.extent, xyz[n, t] / field.extent, reduction="none", delta=_HUBER
        )
        loss = (weights[n, t, None] * miss).sum() / weights[n, t].sum().clamp(min=1e-12)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        decay.step()
    return DeformationField(**{item.name: getattr(field, item.name).detach() for item in fields(field)})


def _untrained(points: Float[Tensor, "n 3"], frames: int, generator: torch.Generator) -> DeformationField:
    """Random layers (He et al. 2015), but for the last one: at first nothing moves."""
    inputs = 3 * (1 + 2 * _POINT_OCTAVES) + 1 + 2 * _TIME_OCTAVES
    low, high = points.amin(0), points.amax(0)
    return DeformationField(
        first=torch.randn(inputs, _HIDDEN, generator=generator) * math.sqrt(2 / inputs),
        hidden=torch.randn(_LAYERS, _HIDDEN, _HIDDEN, generator=generator) * math.sqrt(2 / _HIDDEN),
        biases=torch.zeros(_LAYERS + 1, _HIDDEN),
        last=torch.zeros(_HIDDEN, 7),
        centre=(low + high) / 2,
        extent=((high - low).amax() / 2).clamp(min=1e-6),
        duration=torch.tensor(float(max(frames - 1, 1))),
    )


def _encoded(values: Float[Tensor, "*n c"], octaves: int) -> Float[Tensor, "*n e"]:
    """The values, and sines and cosines of them at frequencies that double (Mildenhall et al. 2020)."""
    waves = (values[..., None] * (math.pi * 2.0 ** torch.arange(octaves, device=values.device))).flatten(-2)
    return torch.cat((values, waves.sin(), waves.cos()), dim=-1)
