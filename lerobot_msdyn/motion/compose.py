"""Where the Gaussians are at a time: the finest motion first, then the coarser ones that carry it (docs/method.md)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.geometry import matrix_to_quaternion, quaternion_multiply, rotation_6d_to_matrix
from lerobot_msdyn.motion.bases import MotionLevel, level_affines

_DEGENERATE = 1e-3  # area spanned by the first two columns of a blend, below which it has no direction left


def compose(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    levels: tuple[MotionLevel, ...],
    indices: tuple[Int[Tensor, "n _"], ...],
    logits: tuple[Float[Tensor, "n _"], ...],
    frames: Int[Tensor, " b"],
) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 4"]]:
    """Means (m) and orientations (wxyz) of Gaussians at some frames, differentiable in everything but the indices.

    `levels` go from coarse to fine. A Gaussian follows, in each level, the few bases in its row of `indices`, mixed by
    softmax(`logits`): the cost does not depend on how many bases there are. Affine maps are mixed, not rotations and
    translations apart, so that a position does not depend on where the pivots or the world's origin lie; the mixed
    map is projected to a rotation for the orientation alone.
    """
    batch = len(frames)
    positions = means.expand(batch, -1, -1)
    orientations = quats.expand(batch, -1, -1)
    for level, index, logit in zip(reversed(levels), reversed(indices), reversed(logits), strict=True):
        affines = level_affines(level, frames)
        blended = _blend(affines, index, torch.softmax(logit, dim=-1))
        positions = (blended[..., :3] @ positions[..., None])[..., 0] + blended[..., 3]
        rotations = _nearest_rotations(blended, affines, index, logit)
        orientations = quaternion_multiply(matrix_to_quaternion(rotations), orientations)
    return positions, orientations


def _blend(
    affines: Float[Tensor, "k b 3 4"], index: Int[Tensor, "n j"], weights: Float[Tensor, "n j"]
) -> Float[Tensor, "b n 3 4"]:
    """Weighted means of the maps that each Gaussian names."""
    batch = affines.shape[1]
    rows = torch.nn.functional.embedding_bag(index, affines.flatten(1), per_sample_weights=weights, mode="sum")
    return rows.reshape(len(index), batch, 3, 4).transpose(0, 1)


def _nearest_rotations(
    blended: Float[Tensor, "b n 3 4"],
    affines: Float[Tensor, "k b 3 4"],
    index: Int[Tensor, "n j"],
    logit: Float[Tensor, "n j"],
) -> Float[Tensor, "b n 3 3"]:
    """Rotations of blended maps; where opposite rotations cancel out, that of the heaviest basis."""
    first, second = blended[..., 0], blended[..., 1]
    degenerate = torch.linalg.cross(first, second).norm(dim=-1, keepdim=True) < _DEGENERATE
    columns = torch.cat((first, second), dim=-1)
    if degenerate.any():
        heaviest = index.gather(1, logit.argmax(dim=1, keepdim=True))[:, 0]
        single = affines[heaviest].transpose(0, 1)
        columns = torch.where(degenerate, torch.cat((single[..., 0], single[..., 1]), dim=-1), columns)
    return rotation_6d_to_matrix(columns)
