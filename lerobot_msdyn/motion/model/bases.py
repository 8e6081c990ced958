"""Motion bases: a level of rigid motions over time, each about its own pivot, and how points follow a few of them."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from lerobot_msdyn.core.geometry import (
    matrix_to_quaternion,
    matrix_to_rotation_6d,
    quaternion_multiply,
    rotation_6d_to_matrix,
)
from lerobot_msdyn.motion.model.carried import DEGENERATE, carried, carried_points

COARSEST = -1  # the parent of a basis that nothing carries

_known_shares: WeakTensorKeyDictionary = WeakTensorKeyDictionary()  # logits -> their version, their softmax


@dataclass(frozen=True)
class MotionLevel:
    """K rigid motions over time (docs/motion.md): A_k,t(x) = R_k,t (x - p_k) + p_k + d_k,t.

    Displacements are those of the pivot, so rotations and displacements are decoupled and both small; at the
    canonical frame every basis is the identity. Between its knots a motion is interpolated linearly, beyond them held.
    """

    kind: ClassVar[str] = "bases"

    rotations_6d: Float[Tensor, "k s 6"]  # first two columns of R, at the knots
    displacements: Float[Tensor, "k s 3"]  # m, at the knots
    knots: Float[Tensor, " s"]  # frames, ascending
    pivots: Float[Tensor, "k 3"]  # m, in the canonical frame
    reach: Float[Tensor, " k"]  # m, typical distance from the pivot of what follows the basis
    parents: Int[Tensor, " k"]  # index of the basis of the coarser level, COARSEST if there is none
    active: Bool[Tensor, " k"]  # an inactive basis is the identity, and is not learned

    def __len__(self) -> int:
        return self.pivots.shape[0]

    @cached_property
    def _moves(self) -> bool:
        """Whether any basis is active, asked of its device once."""
        return bool(self.active.any())

    @cached_property
    def _at_frames(self) -> tuple[int, Float[Tensor, "k t 3 4"]]:
        """The first knot, and the maps of every basis at the frames from there to the last knot."""
        first, last = int(self.knots[0]), int(self.knots[-1])
        return first, level_affines(self, torch.arange(first, last + 1, device=self.knots.device))

    def affines(self, times: Float[Tensor, " b"] | Int[Tensor, " b"]) -> Float[Tensor, "k b 3 4"]:
        """The maps of every basis at some times, in frames: `level_affines`, computed once unless they are learned."""
        learned = self.rotations_6d.requires_grad or self.displacements.requires_grad
        if learned or times.is_floating_point():
            return level_affines(self, times)
        first, maps = self._at_frames
        return maps[:, (times - first).clamp(0, maps.shape[1] - 1)]

    def carry(
        self,
        positions: Float[Tensor, "b n 3"],
        orientations: Float[Tensor, "b n 4"],
        indices: Int[Tensor, "n j"],
        logits: Float[Tensor, "n j"],
        times: Float[Tensor, " b"] | Int[Tensor, " b"],
    ) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 4"]]:
        """Positions (m) and orientations (wxyz) moved by the bases that each point names, at the times of the batch."""
        if not self._moves:
            return positions, orientations
        affines = self.affines(times)
        if _compiled(affines, positions):
            return carried(affines, shares_of(logits), indices, positions, orientations)
        blended = blend(affines, indices, logits)
        rotations = _nearest_rotations(blended, affines, indices, logits)
        turned = quaternion_multiply(matrix_to_quaternion(rotations), orientations)
        return _applied(blended, positions), turned

    def carry_points(
        self,
        positions: Float[Tensor, "b n 3"],
        indices: Int[Tensor, "n j"],
        logits: Float[Tensor, "n j"],
        times: Float[Tensor, " b"] | Int[Tensor, " b"],
    ) -> Float[Tensor, "b n 3"]:
        """Positions (m) as `carry` moves them, without orientations, which take most of its time."""
        if not self._moves:
            return positions
        affines = self.affines(times)
        if _compiled(affines, positions):
            return carried_points(affines, shares_of(logits), indices, positions)
        return _applied(blend(affines, indices, logits), positions)


def shares_of(logits: Float[Tensor, "n j"]) -> Float[Tensor, "n j"]:
    """By how much each point follows its bases: softmax, computed once for logits that nobody learns or changes."""
    if logits.requires_grad:
        return torch.softmax(logits, dim=-1)
    version, shares = _known_shares.get(logits, (None, logits))
    if version != logits._version:
        shares = torch.softmax(logits, dim=-1)
        _known_shares[logits] = (logits._version, shares)
    return shares


def _compiled(affines: Tensor, positions: Tensor) -> bool:
    return affines.dtype == positions.dtype == torch.float32 and not affines.is_cuda


def _applied(maps: Float[Tensor, "b n 3 4"], points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
    return (maps[..., :3] @ points[..., None])[..., 0] + maps[..., 3]


def identity_level(pivots: Float[Tensor, "k 3"], frames: int) -> MotionLevel:
    """A coarsest level in which nothing moves."""
    motions = torch.eye(4, dtype=pivots.dtype, device=pivots.device).repeat(len(pivots), frames, 1, 1)
    return level_from_motions(motions, pivots)


def level_from_motions(
    motions: Float[Tensor, "k t 4 4"],
    pivots: Float[Tensor, "k 3"],
    *,
    reach: Float[Tensor, " k"] | None = None,
    parents: Int[Tensor, " k"] | None = None,
    active: Bool[Tensor, " k"] | None = None,
    frames_per_knot: int = 1,
    canonical: int = 0,
) -> MotionLevel:
    """A level from rigid motions that carry canonical points to where they are at each frame.

    Knots stand `frames_per_knot` apart, counted from the canonical frame so that one falls on it, and at both ends.
    Left out: a reach of 1 m, no parents, every basis active.
    """
    count, frames = motions.shape[:2]
    device = pivots.device
    knots = knot_frames(frames, frames_per_knot, canonical).to(device)
    chosen = motions[:, knots]
    moved = (chosen[..., :3, :3] @ pivots[:, None, :, None])[..., 0] + chosen[..., :3, 3]
    return MotionLevel(
        matrix_to_rotation_6d(chosen[..., :3, :3]),
        moved - pivots[:, None],
        knots.to(pivots.dtype),
        pivots,
        torch.ones(count, dtype=pivots.dtype, device=device) if reach is None else reach,
        torch.full((count,), COARSEST, dtype=torch.long, device=device) if parents is None else parents,
        torch.ones(count, dtype=torch.bool, device=device) if active is None else active,
    )


def with_idle(level: MotionLevel) -> MotionLevel:
    """The level with one more basis behind the others, which is the identity and stays it."""
    unturned = level.rotations_6d.new_tensor([1.0, 0, 0, 0, 1, 0]).expand_as(level.rotations_6d[:1])
    return MotionLevel(
        torch.cat((level.rotations_6d, unturned)),
        torch.cat((level.displacements, torch.zeros_like(level.displacements[:1]))),
        level.knots,
        torch.cat((level.pivots, torch.zeros_like(level.pivots[:1]))),
        torch.cat((level.reach, torch.ones_like(level.reach[:1]))),
        torch.cat((level.parents, torch.full_like(level.parents[:1], COARSEST))),
        torch.cat((level.active, torch.zeros_like(level.active[:1]))),
    )


def knot_frames(frames: int, frames_per_knot: int, canonical: int = 0) -> Int[Tensor, " s"]:
    """Frames `frames_per_knot` apart, through the canonical one, and the first and the last."""
    regular = torch.arange(canonical % frames_per_knot, frames, frames_per_knot)
    return torch.cat((torch.tensor([0]), regular, torch.tensor([frames - 1]))).unique()


def level_affines(level: MotionLevel, times: Float[Tensor, " b"] | Int[Tensor, " b"]) -> Float[Tensor, "k b 3 4"]:
    """The maps [R | p + d - R p] of every basis at some times, in frames."""
    times = times.to(level.knots)
    after = torch.searchsorted(level.knots, times).clamp(max=len(level.knots) - 1)
    before = (after - 1).clamp(min=0)
    gap = (level.knots[after] - level.knots[before]).clamp(min=1e-9)
    fraction = ((times - level.knots[before]) / gap).clamp(0, 1)[:, None]
    rotations = rotation_6d_to_matrix(torch.lerp(level.rotations_6d[:, before], level.rotations_6d[:, after], fraction))
    displacements = torch.lerp(level.displacements[:, before], level.displacements[:, after], fraction)
    rotated = (rotations @ level.pivots[:, None, :, None])[..., 0]
    affines = torch.cat((rotations, (level.pivots[:, None] + displacements - rotated)[..., None]), dim=-1)
    still = torch.eye(3, 4, dtype=affines.dtype, device=affines.device)
    return torch.where(level.active[:, None, None, None], affines, still)


def blend(
    affines: Float[Tensor, "k b 3 4"], indices: Int[Tensor, "n j"], logits: Float[Tensor, "n j"]
) -> Float[Tensor, "b n 3 4"]:
    """The maps that each point names, mixed by softmax of its logits; O(j) a point, however many maps there are."""
    batch, weights = affines.shape[1], torch.softmax(logits, dim=-1)
    rows = torch.nn.functional.embedding_bag(indices, affines.flatten(1), per_sample_weights=weights, mode="sum")
    return rows.reshape(len(indices), batch, 3, 4).transpose(0, 1)


def _nearest_rotations(
    blended: Float[Tensor, "b n 3 4"],
    affines: Float[Tensor, "k b 3 4"],
    indices: Int[Tensor, "n j"],
    logits: Float[Tensor, "n j"],
) -> Float[Tensor, "b n 3 3"]:
    """Rotations of blended maps; where opposite rotations cancel out, that of the heaviest basis."""
    first, second = blended[..., 0], blended[..., 1]
    degenerate = torch.linalg.cross(first, second).norm(dim=-1, keepdim=True) < DEGENERATE
    columns = torch.cat((first, second), dim=-1)
    if degenerate.is_cuda or degenerate.any():  # on a GPU, waiting for the answer takes longer
        heaviest = indices.gather(1, logits.argmax(dim=1, keepdim=True))[:, 0]
        single = affines[heaviest].transpose(0, 1)
        columns = torch.where(degenerate, torch.cat((single[..., 0], single[..., 1]), dim=-1), columns)
    return rotation_6d_to_matrix(columns)
