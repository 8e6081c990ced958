"""Frames in which a part cannot be followed: what carries it there, and how the gap is filled."""

import torch
from jaxtyping import Bool, Float, Int
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch import Tensor

from lerobot_msdyn.core.geometry import axis_angle_to_matrix, invert_se3, se3, transform_points

STILL = -1  # the carrier of what rests, or of what nothing carries
_WINDOW = 10  # accepted frames beside a gap that tell what carries a part
_STEP = 5  # frames over which motions are compared
_MIN_COVERED = 0.5  # of a part's gaps, that its carrier must have been followed through
_CLEARLY = 0.5  # a carrier must explain the motion so much better than standing still does


def find_carriers(
    motions: Float[Tensor, "k t 4 4"], accepted: Bool[Tensor, "k t"], pivots: Float[Tensor, "k 3"]
) -> Int[Tensor, " k"]:
    """For each part, the part that it moves with beside its gaps (a block with the gripper), or STILL.

    `motions` carry the points of a part's reference frame to each frame, `pivots` are at that frame.
    """
    return torch.tensor(
        [_carrier(part, motions, accepted, pivots[part]) for part in range(len(motions))], dtype=torch.long
    )


def _carrier(
    part: int, motions: Float[Tensor, "k t 4 4"], accepted: Bool[Tensor, "k t"], pivot: Float[Tensor, "3"]
) -> int:
    followed = accepted[part]
    if followed.all() or not followed.any():
        return STILL
    gap = (~followed).float()
    near = torch.nn.functional.max_pool1d(gap[None], 2 * _WINDOW + 1, stride=1, padding=_WINDOW)[0] > 0
    start = (near & followed)[:-_STEP].nonzero()[:, 0]
    start = start[followed[start + _STEP]]
    if len(start) == 0:
        return STILL
    place = (motions[part, :, :3, :3] @ pivot) + motions[part, :, :3, 3]  # of the part, at every frame
    moved = place[start + _STEP] - place[start]
    best, least = STILL, _CLEARLY * float(moved.norm(dim=-1).mean())
    for other in range(len(motions)):
        together = accepted[other, start] & accepted[other, start + _STEP]
        covers = (accepted[other] & ~followed).sum() >= _MIN_COVERED * (~followed).sum()
        if other == part or not covers or together.sum() < len(start) / 2:
            continue
        step = motions[other, start + _STEP] @ invert_se3(motions[other, start])
        carried = transform_points(step, place[start][:, None])[:, 0]
        error = float((carried - place[start + _STEP]).norm(dim=-1)[together].mean())
        if error < least:
            best, least = other, error
    return best


def fill_gaps(
    motions: Float[Tensor, "t 4 4"],
    accepted: Bool[Tensor, " t"],
    pivot: Float[Tensor, "3"],
    carry: Float[Tensor, "t 4 4"] | None = None,
) -> Float[Tensor, "t 4 4"]:
    """Motions also where none was accepted.

    A part moves with its carrier, if it has one, else it stands still: from the last accepted frame onward and from
    the next one backward, mixed in proportion (slerp, and lerp of the pivot). Beyond the first and last accepted
    frames there is only one side.
    """
    supported = accepted.nonzero()[:, 0]
    if len(supported) == 0:
        return torch.eye(4, dtype=motions.dtype).repeat(len(motions), 1, 1)
    time = torch.arange(len(motions))
    after = supported[torch.searchsorted(supported, time).clamp(max=len(supported) - 1)]
    before = supported[(torch.searchsorted(supported, time, right=True) - 1).clamp(min=0)]
    fraction = ((time - before) / (after - before).clamp(min=1)).clamp(0, 1).to(motions.dtype)[:, None]
    start, end = motions[before], motions[after]
    if carry is not None:
        start = carry @ invert_se3(carry[before]) @ start
        end = carry @ invert_se3(carry[after]) @ end
    return _between(start, end, fraction, pivot)


def _between(
    start: Float[Tensor, "t 4 4"],
    end: Float[Tensor, "t 4 4"],
    fraction: Float[Tensor, "t 1"],
    pivot: Float[Tensor, "3"],
) -> Float[Tensor, "t 4 4"]:
    turn = rotation_matrix_to_axis_angle((start[:, :3, :3].transpose(1, 2) @ end[:, :3, :3]).contiguous())
    rotation = start[:, :3, :3] @ axis_angle_to_matrix(fraction * turn)
    centre = pivot.expand(len(start), 1, 3)
    moved = torch.lerp(transform_points(start, centre)[:, 0], transform_points(end, centre)[:, 0], fraction)
    return se3(rotation, moved - rotation @ pivot)
