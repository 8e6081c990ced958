"""Colours of what moves, seen from a place, on a CPU: spherical harmonics of degree 1 in one compiled pass, both ways.

`shaded_moving` in torch defines what is right. Points are taken in blocks of a fixed size: the same bits for any
number of threads.
"""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.compiled import compiled, inlined
from lerobot_msdyn.core.geometry import quaternion_conjugate, quaternion_multiply, quaternion_to_matrix
from lerobot_msdyn.render.cpu.simd import take_ticket
from lerobot_msdyn.render.cpu.threads import POINTS_PER_TICKET, point_tickets, run
from lerobot_msdyn.scene.gaussians import SH_C0, SH_C1, shaded

TINY = 1e-24  # squared length of an orientation, below which it is none


def shaded_moving(
    sh: Float[Tensor, "m 4 3"],
    canonical: Float[Tensor, "m 4"],
    quats: Float[Tensor, "b m 4"],
    means: Float[Tensor, "b m 3"],
    eye: Float[Tensor, "b 3"],
) -> Float[Tensor, "b m 3"]:
    """Colours 0..1 of Gaussians that have turned since the canonical frame, in which their harmonics are fixed.

    Args:
        sh: harmonics of degree 1.
        canonical: orientations at the canonical frame (wxyz, of any length).
        quats: orientations now.
        means: where they are now, m.
        eye: from where they are seen, m.
    """
    if means.is_cuda or means.dtype != torch.float32:
        back = quaternion_multiply(canonical, quaternion_conjugate(quats))
        sight = torch.nn.functional.normalize(means - eye[:, None], dim=-1)
        return shaded(sh, (quaternion_to_matrix(back) @ sight[..., None])[..., 0])
    colours: Tensor = _Seen.apply(sh, canonical, quats, means, eye)
    return colours


class _Seen(torch.autograd.Function):
    """Arguments as `shaded_moving` has them; the eye is not learned."""

    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> Tensor:
        inputs = [each.detach().contiguous() for each in given]
        colours = torch.empty_like(inputs[3])
        run(_forward, point_tickets(*colours.shape[:2]), *(each.numpy() for each in inputs), colours.numpy())
        ctx.save_for_backward(*inputs, colours)
        return colours

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, colours = ctx.saved_tensors
        sh, canonical, quats, means, _ = inputs
        batch = len(means)
        to_sh, to_canonical = (means.new_empty(batch, *each.shape) for each in (sh, canonical))
        to_quats, to_means = torch.empty_like(quats), torch.empty_like(means)
        results = (to_sh, to_canonical, to_quats, to_means)
        arrays = (*inputs, colours, gradients[0].contiguous(), *results)
        run(_backward, point_tickets(*means.shape[:2]), *(each.numpy() for each in arrays))
        return to_sh.sum(0), to_canonical.sum(0), to_quats, to_means, None


@inlined
def _turned(w: float, x: float, y: float, z: float, v0: float, v1: float, v2: float) -> tuple[float, float, float]:
    """A vector rotated by a quaternion of any length."""
    s = 2.0 / max(w * w + x * x + y * y + z * z, TINY)
    c0, c1, c2 = y * v2 - z * v1, z * v0 - x * v2, x * v1 - y * v0
    return (
        v0 + s * (w * c0 + y * c2 - z * c1),
        v1 + s * (w * c1 + z * c0 - x * c2),
        v2 + s * (w * c2 + x * c1 - y * c0),
    )


@inlined
def _sight(means: ndarray, eye: ndarray, time: int, point: int) -> tuple[float, float, float, float]:
    """Direction from the eye, and the distance, m."""
    mean, origin = means[time, point], eye[time]
    x, y, z = mean[0] - origin[0], mean[1] - origin[1], mean[2] - origin[2]
    length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    return x / length, y / length, z / length, length


@compiled
def _forward(
    tickets: ndarray,
    sh: ndarray,
    canonical: ndarray,
    quats: ndarray,
    means: ndarray,
    eye: ndarray,
    colours: ndarray,
) -> None:
    """Of the blocks that this thread draws."""
    batch, count = means.shape[:2]
    blocks = -(-count // POINTS_PER_TICKET)
    ticket = take_ticket(tickets)
    while ticket < batch * blocks:
        time, block = ticket // blocks, ticket % blocks
        for point in range(block * POINTS_PER_TICKET, min(count, (block + 1) * POINTS_PER_TICKET)):
            x, y, z, _ = _sight(means, eye, time, point)
            w, i, j, k = quats[time, point]
            x, y, z = _turned(w, -i, -j, -k, x, y, z)
            w, i, j, k = canonical[point]
            x, y, z = _turned(w, i, j, k, x, y, z)
            for channel in range(3):
                linear = z * sh[point, 2, channel] - y * sh[point, 1, channel] - x * sh[point, 3, channel]
                colours[time, point, channel] = max(SH_C0 * sh[point, 0, channel] + SH_C1 * linear + 0.5, 0.0)
        ticket = take_ticket(tickets)


@compiled
def _backward(
    tickets: ndarray,
    sh: ndarray,
    canonical: ndarray,
    quats: ndarray,
    means: ndarray,
    eye: ndarray,
    colours: ndarray,
    to_colours: ndarray,
    to_sh: ndarray,
    to_canonical: ndarray,
    to_quats: ndarray,
    to_means: ndarray,
) -> None:
    """Gradients, given those of the colours.

    A change w (a rotation vector) of an orientation q changes it by (0, w) q / 2, so that a gradient g of w is one of
    2 (0, g) q / |q|^2 of q.
    """
    batch, count = means.shape[:2]
    blocks = -(-count // POINTS_PER_TICKET)
    ticket = take_ticket(tickets)
    while ticket < batch * blocks:
        time, block = ticket // blocks, ticket % blocks
        for point in range(block * POINTS_PER_TICKET, min(count, (block + 1) * POINTS_PER_TICKET)):
            s0, s1, s2, length = _sight(means, eye, time, point)
            qw, qx, qy, qz = quats[time, point]
            cw, cx, cy, cz = canonical[point]
            x, y, z = _turned(qw, -qx, -qy, -qz, s0, s1, s2)
            x, y, z = _turned(cw, cx, cy, cz, x, y, z)
            g0, g1, g2 = np.float32(0), np.float32(0), np.float32(0)  # of the direction in the canonical frame
            for channel in range(3):
                g = to_colours[time, point, channel] if colours[time, point, channel] > 0 else np.float32(0)
                linear = SH_C1 * g
                to_sh[time, point, 0, channel] = SH_C0 * g
                to_sh[time, point, 1, channel] = -y * linear
                to_sh[time, point, 2, channel] = z * linear
                to_sh[time, point, 3, channel] = -x * linear
                g0 -= linear * sh[point, 3, channel]
                g1 -= linear * sh[point, 1, channel]
                g2 += linear * sh[point, 2, channel]
            w0, w1, w2 = y * g2 - z * g1, z * g0 - x * g2, x * g1 - y * g0
            unit = 2.0 / max(cw * cw + cx * cx + cy * cy + cz * cz, TINY)
            to_canonical[time, point, 0] = -unit * (w0 * cx + w1 * cy + w2 * cz)
            to_canonical[time, point, 1] = unit * (w0 * cw + w1 * cz - w2 * cy)
            to_canonical[time, point, 2] = unit * (w1 * cw + w2 * cx - w0 * cz)
            to_canonical[time, point, 3] = unit * (w2 * cw + w0 * cy - w1 * cx)
            g0, g1, g2 = _turned(cw, -cx, -cy, -cz, g0, g1, g2)
            g0, g1, g2 = _turned(qw, qx, qy, qz, g0, g1, g2)  # of the direction in the world
            w0, w1, w2 = g1 * s2 - g2 * s1, g2 * s0 - g0 * s2, g0 * s1 - g1 * s0
            unit = 2.0 / max(qw * qw + qx * qx + qy * qy + qz * qz, TINY)
            to_quats[time, point, 0] = -unit * (w0 * qx + w1 * qy + w2 * qz)
            to_quats[time, point, 1] = unit * (w0 * qw + w1 * qz - w2 * qy)
            to_quats[time, point, 2] = unit * (w1 * qw + w2 * qx - w0 * qz)
            to_quats[time, point, 3] = unit * (w2 * qw + w0 * qy - w1 * qx)
            along = g0 * s0 + g1 * s1 + g2 * s2
            to_means[time, point, 0] = (g0 - along * s0) / length
            to_means[time, point, 1] = (g1 - along * s1) / length
            to_means[time, point, 2] = (g2 - along * s2) / length
        ticket = take_ticket(tickets)
