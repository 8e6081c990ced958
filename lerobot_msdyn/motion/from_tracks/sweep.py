"""First rigid motions of groups of tracks, compiled: frame after frame, each by robust Procrustes against the last.

A frame takes five small fits, each of which would be some twenty tensor operations on a hundred numbers.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.compiled import compiled, inlined
from lerobot_msdyn.core.rotations import rotate_nearest
from lerobot_msdyn.render.cpu.simd import take_ticket
from lerobot_msdyn.render.cpu.threads import run

_IRLS_STEPS = 5
NORMAL_MAD = 1.4826  # standard deviations in the median absolute deviation of a normal distribution
_MODEL_MEMORY = 10  # observations that a model point averages while the clip is swept


def swept(
    xyz: Float[Tensor, "n t 3"],
    weights: Float[Tensor, "h n t"],
    reference: Int[Tensor, " h"],
    floor: Float[Tensor, " h"],
    min_effective: float,
    carry: Float[Tensor, "h t 4 4"] | None,
) -> tuple[Float[Tensor, "h t 4 4"], Float[Tensor, "h t"]]:
    """Motions from each group's reference frame outward, every frame against the model so far; and what supports them.

    A frame's motion starts from that of the neighbouring frame, or from where the carrier takes it: what follows the
    body is near it, what does not need not be. Where the model is not seen but enough other tracks are, the carrier's
    word is taken.

    Args:
        xyz: the tracks, m, in float64.
        weights: of the tracks in each group; 0: not a member, or not seen.
        reference: the frame at which a group's motion is the identity.
        floor: smallest scale (m) of each group's robust weights.
        min_effective: effective number of tracks that a frame needs.
        carry: motion of what carries each group.
    """
    groups, _, frames = weights.shape
    motions = np.zeros((groups, frames, 4, 4))
    support = np.zeros((groups, frames))
    carried = np.zeros((0, frames, 4, 4)) if carry is None else carry.double().numpy()
    tensors = (xyz.double(), weights.double(), reference, floor.double())
    run(_swept, groups, *(each.contiguous().numpy() for each in tensors), min_effective, carried, motions, support)
    return torch.from_numpy(motions), torch.from_numpy(support)


@inlined
def _effective(weights: ndarray) -> float:
    """Effective number of points: (sum w)^2 / sum w^2."""
    total, square = 0.0, 0.0
    for weight in weights:
        total += weight
        square += weight * weight
    return total * total / max(square, 1e-30)


@inlined
def _procrustes(
    source: ndarray, target: ndarray, weights: ndarray, a: ndarray, v: ndarray, sums: ndarray, motion: ndarray
) -> None:
    """The rigid motion that best carries `source` onto `target`, into `motion` [4,4]."""
    total = 0.0
    mean = np.zeros((2, 3))
    for i in range(len(weights)):
        total += weights[i]
        for axis in range(3):
            mean[0, axis] += weights[i] * source[i, axis]
            mean[1, axis] += weights[i] * target[i, axis]
    total = max(total, 1e-12)
    mean /= total
    sums[:] = 0.0
    for i in range(len(weights)):
        if weights[i] == 0.0:
            continue
        for row in range(3):
            off = weights[i] / total * (target[i, row] - mean[1, row])
            for column in range(3):
                sums[row, column] += off * (source[i, column] - mean[0, column])
    rotate_nearest(sums, a, v, motion)
    for row in range(3):
        motion[row, 3] = mean[1, row]
        for axis in range(3):
            motion[row, 3] -= motion[row, axis] * mean[0, axis]


@inlined
def _median_of(values: ndarray, count: int) -> float:
    """The lower median of the first values; 0 of none."""
    return np.sort(values[:count])[(count - 1) // 2] if count > 0 else 0.0


@compiled
def _swept(
    tickets: ndarray,
    xyz: ndarray,
    weights: ndarray,
    reference: ndarray,
    floor: ndarray,
    min_effective: float,
    carry: ndarray,
    motions: ndarray,
    support: ndarray,
) -> None:
    """Of the groups that this thread draws."""
    groups, n, frames = weights.shape
    distance, some, robust, usable = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    a, v, sums = np.empty((4, 4)), np.empty((4, 4)), np.empty((3, 3))
    model, target, count = np.empty((n, 3)), np.empty((n, 3)), np.empty(n)
    last, motion, spare = np.empty((4, 4)), np.eye(4), np.empty((4, 4))
    group = take_ticket(tickets)
    while group < groups:
        start = reference[group]
        for i in range(n):
            count[i] = 1.0 if weights[group, i, start] > 0 else 0.0
            for axis in range(3):
                model[i, axis] = xyz[i, start, axis]
        for i in range(4):
            motions[group, :, i, i] = 1.0
        support[group, start] = _effective(weights[group, :, start])
        for direction in (1, -1):
            last[:] = np.eye(4)
            frame = start + direction
            while 0 <= frame < frames:
                seen = weights[group, :, frame]
                for i in range(n):
                    usable[i] = seen[i] if count[i] > 0 else 0.0
                    for axis in range(3):
                        target[i, axis] = xyz[i, frame, axis]
                if len(carry) > 0:
                    _inverse(carry[group, frame - direction], spare)
                    _multiply(carry[group, frame], spare, motion)
                    _multiply(motion, last, spare)
                    last[:] = spare
                motion[:] = last
                for _ in range(_IRLS_STEPS):
                    taking_part = 0
                    for i in range(n):
                        distance[i] = _distance(motion, model, target, i)
                        if usable[i] > 0:
                            some[taking_part] = distance[i]
                            taking_part += 1
                    scale = max(NORMAL_MAD * _median_of(some, taking_part), floor[group])
                    for i in range(n):
                        ratio = distance[i] / scale
                        robust[i] = usable[i] / ((1 + ratio * ratio) * (1 + ratio * ratio))
                    _procrustes(model, target, robust, a, v, sums, motion)
                effective = _effective(robust)
                accepted = effective >= min_effective
                restarted = not accepted and len(carry) > 0 and _effective(seen) >= min_effective
                if accepted:
                    last[:] = motion
                motions[group, frame] = last
                if accepted or restarted:
                    support[group, frame] = max(effective, 1e-6)
                    for i in range(n):
                        if seen[i] > 0:
                            _average(model, target, last, i, 1 / (count[i] + 1))
                            count[i] = min(count[i] + 1, _MODEL_MEMORY)
                frame += direction
        group = take_ticket(tickets)


@inlined
def _distance(motion: ndarray, model: ndarray, target: ndarray, i: int) -> float:
    """From where a motion takes a point to where it is seen."""
    total = 0.0
    for row in range(3):
        off = motion[row, 3] - target[i, row]
        for axis in range(3):
            off += motion[row, axis] * model[i, axis]
        total += off * off
    return math.sqrt(total)


@inlined
def _average(model: ndarray, target: ndarray, motion: ndarray, i: int, rate: float) -> None:
    """Take an observation, carried back by its frame's motion, into the average of a model point."""
    for axis in range(3):
        back = 0.0
        for row in range(3):
            back += motion[row, axis] * (target[i, row] - motion[row, 3])
        model[i, axis] += rate * (back - model[i, axis])


@inlined
def _inverse(motion: ndarray, result: ndarray) -> None:
    """Of a rigid motion."""
    result[:] = 0.0
    result[3, 3] = 1.0
    for axis in range(3):
        for row in range(3):
            result[axis, row] = motion[row, axis]
            result[axis, 3] -= motion[row, axis] * motion[row, 3]


@inlined
def _multiply(a: ndarray, b: ndarray, result: ndarray) -> None:
    """Of 4x4 matrices."""
    for row in range(4):
        for column in range(4):
            result[row, column] = 0.0
            for k in range(4):
                result[row, column] += a[row, k] * b[k, column]
