"""Motion bases: a level of rigid motions over time, each about its own pivot."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.geometry import matrix_to_rotation_6d, rotation_6d_to_matrix


@dataclass(frozen=True)
class MotionLevel:
    """K rigid motions over T frames (docs/method.md): A_k,t(x) = R_k,t (x - p_k) + p_k + d_k,t.

    Displacements are those of the pivot, so rotations and displacements are decoupled and both small; at the
    canonical frame every basis is the identity.
    """

    rotations_6d: Float[Tensor, "k t 6"]  # first two columns of R
    displacements: Float[Tensor, "k t 3"]  # m
    pivots: Float[Tensor, "k 3"]  # m, in the canonical frame
    parents: Int[Tensor, " k"]  # index of the basis of the coarser level, -1 at the coarsest
    active: Bool[Tensor, " k"]  # an inactive basis is the identity

    def __len__(self) -> int:
        return self.pivots.shape[0]


def identity_level(pivots: Float[Tensor, "k 3"], frames: int) -> MotionLevel:
    """A coarsest level in which nothing moves."""
    motions = torch.eye(4, dtype=pivots.dtype, device=pivots.device).repeat(len(pivots), frames, 1, 1)
    return level_from_motions(motions, pivots)


def level_from_motions(motions: Float[Tensor, "k t 4 4"], pivots: Float[Tensor, "k 3"]) -> MotionLevel:
    """A coarsest level from rigid motions that carry canonical world points to where they are at each frame."""
    moved = (motions[..., :3, :3] @ pivots[:, None, :, None])[..., 0] + motions[..., :3, 3]
    count, device = len(pivots), pivots.device
    return MotionLevel(
        matrix_to_rotation_6d(motions[..., :3, :3]),
        moved - pivots[:, None],
        pivots,
        parents=torch.full((count,), -1, dtype=torch.long, device=device),
        active=torch.ones(count, dtype=torch.bool, device=device),
    )


def level_affines(level: MotionLevel, frames: Int[Tensor, " b"]) -> Float[Tensor, "k b 3 4"]:
    """The maps [R | p + d - R p] of every basis at some frames."""
    rotations = rotation_6d_to_matrix(level.rotations_6d[:, frames])
    rotated = (rotations @ level.pivots[:, None, :, None])[..., 0]
    offsets = level.pivots[:, None] + level.displacements[:, frames] - rotated
    affines = torch.cat((rotations, offsets[..., None]), dim=-1)
    still = torch.eye(3, 4, dtype=affines.dtype, device=affines.device)
    return torch.where(level.active[:, None, None, None], affines, still)


def carried(
    level: MotionLevel, basis: Int[Tensor, " n"], points: Float[Tensor, "n 3"], frame: int
) -> Float[Tensor, "n 3"]:
    """Canonical points (m), each where its own basis carries it at a frame."""
    affine = level_affines(level, torch.tensor([frame]))[basis, 0]
    return (affine[:, :, :3] @ points[:, :, None])[..., 0] + affine[:, :, 3]
