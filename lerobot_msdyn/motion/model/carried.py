"""`MotionLevel.carry` on a CPU, compiled: blending, rotations and quaternions of a point in one pass, both ways.

The torch route in `bases` defines what is right; this one is several times faster, since none of the many small
tensors in between is ever written. Points are taken in blocks of a fixed size, whose gradients are summed in order:
the same bits for any number of threads.
"""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.compiled import compiled, inlined
from lerobot_msdyn.render.cpu.simd import take_ticket
from lerobot_msdyn.render.cpu.threads import POINTS_PER_TICKET, point_tickets, run

DEGENERATE = 1e-3  # area spanned by the first two columns of a blend, below which it has no direction left


def carried(
    affines: Float[Tensor, "k b 3 4"],
    weights: Float[Tensor, "n j"],
    indices: Int[Tensor, "n j"],
    positions: Float[Tensor, "b n 3"],
    orientations: Float[Tensor, "b n 4"],
) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 4"]]:
    """Positions (m) and orientations (wxyz) moved by mixed maps; differentiable in all but the indices.

    Args:
        affines: of every basis at the times of the batch.
        weights: of the bases that each point follows; a row adds up to 1.
        indices: these bases.
        positions: of the points, m.
        orientations: of the points.
    """
    moved, turned = _Carry.apply(affines, weights, indices, positions, orientations)
    return moved, turned


def carried_points(
    affines: Float[Tensor, "k b 3 4"],
    weights: Float[Tensor, "n j"],
    indices: Int[Tensor, "n j"],
    positions: Float[Tensor, "b n 3"],
) -> Float[Tensor, "b n 3"]:
    """Positions (m) as `carried` moves them."""
    moved: Tensor = _Carry.apply(affines, weights, indices, positions, positions.new_zeros(len(positions), 0, 4))[0]
    return moved


def add_level(
    affines: Float[Tensor, "k b 3 4"],
    weights: Float[Tensor, "n j"],
    indices: Int[Tensor, "n j"],
    maps: Float[Tensor, "b n 12"],
    turns: Float[Tensor, "b n 4"],
) -> None:
    """Have mixed maps follow what has been composed of finer levels, in place.

    Args:
        affines: of every basis at the times of the batch.
        weights: of the bases that each point follows; a row adds up to 1.
        indices: these bases.
        maps: the points' maps so far, row by row.
        turns: the rotations that they turn by so far, wxyz.
    """
    arrays = [each.contiguous().numpy() for each in (affines.reshape(*affines.shape[:2], 12), weights, indices)]
    run(_add_level, point_tickets(*maps.shape[:2]), *arrays, maps.numpy(), turns.numpy())


def applied(
    maps: Float[Tensor, "b n 12"],
    turns: Float[Tensor, "b n 4"],
    positions: Float[Tensor, "b n 3"],
    orientations: Float[Tensor, "b n 4"],
) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 4"]]:
    """Positions (m) and orientations (wxyz) moved by maps that are known; differentiable in these two."""
    moved, turned = _Apply.apply(maps, turns, positions, orientations)
    return moved, turned


class _Apply(torch.autograd.Function):
    """Arguments and results as `applied` has them."""

    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> tuple[Tensor, Tensor]:
        inputs = [each.detach().contiguous() for each in given]
        moved, turned = torch.empty_like(inputs[2]), torch.empty_like(inputs[3])
        arrays = [each.numpy() for each in (*inputs, moved, turned)]
        run(_apply, point_tickets(*moved.shape[:2]), *arrays)
        ctx.save_for_backward(*inputs[:2])
        return moved, turned

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        to_points = [torch.empty(each.shape) for each in gradients]
        arrays = [each.contiguous().numpy() for each in (*ctx.saved_tensors, *gradients, *to_points)]
        run(_apply_back, point_tickets(*gradients[0].shape[:2]), *arrays)
        return None, None, *to_points


class _Carry(torch.autograd.Function):
    """Arguments and results as `carried` has them; no points in `quats` where they are not wanted."""

    @staticmethod
    def forward(
        ctx: Any, affines: Tensor, weights: Tensor, indices: Tensor, positions: Tensor, quats: Tensor
    ) -> tuple[Tensor, Tensor]:
        inputs = [each.detach().contiguous() for each in (affines, weights, indices, positions, quats)]
        moved, turned = torch.empty_like(inputs[3]), torch.empty_like(inputs[4])
        arrays = [each.numpy() for each in inputs]
        arrays[0] = arrays[0].reshape(*affines.shape[:2], 12)
        run(_forward, point_tickets(*positions.shape[:2]), *arrays, moved.numpy(), turned.numpy())
        ctx.save_for_backward(*inputs)
        return moved, turned

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        affines, weights, indices, positions, quats = ctx.saved_tensors
        learned = any(ctx.needs_input_grad[:2])
        given = [each.contiguous().numpy() for each in gradients]
        tickets = point_tickets(*positions.shape[:2])
        to_affines = np.zeros((tickets if learned else 0, len(affines), 12), np.float32)
        to_weights = np.empty((len(positions) if learned else 0, *weights.shape), np.float32)
        to_positions, to_quats = (np.empty(each.shape, np.float32) for each in (positions, quats))
        run(
            _backward,
            tickets,
            affines.numpy().reshape(*affines.shape[:2], 12),
            *(each.numpy() for each in (weights, indices, positions, quats)),
            *given,
            to_affines,
            to_weights,
            to_positions,
            to_quats,
        )
        to_points = torch.from_numpy(to_positions), torch.from_numpy(to_quats)
        if not learned:
            return None, None, None, *to_points
        by_time = torch.from_numpy(to_affines).unflatten(0, (len(positions), -1)).sum(1).transpose(0, 1)
        return by_time.reshape(affines.shape), torch.from_numpy(to_weights).sum(0), None, *to_points


@inlined
def _columns(
    map_: ndarray, indices: ndarray, weights: ndarray, affines: ndarray, time: int, point: int
) -> tuple[float, ...]:
    """The first two columns whose directions become the rotation's; whether they are those of the heaviest basis."""
    a0, a1, a2, b0, b1, b2 = map_[0], map_[4], map_[8], map_[1], map_[5], map_[9]
    x, y, z = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    if x * x + y * y + z * z >= DEGENERATE * DEGENERATE:
        return a0, a1, a2, b0, b1, b2, -1
    heaviest = 0
    for slot in range(1, indices.shape[1]):
        if weights[point, slot] > weights[point, heaviest]:
            heaviest = slot
    basis = indices[point, heaviest]
    single = affines[basis, time]
    return single[0], single[4], single[8], single[1], single[5], single[9], basis


@inlined
def _blended(map_: ndarray, affines: ndarray, weights: ndarray, indices: ndarray, time: int, point: int) -> None:
    """The mixed map of a point, row by row, into `map_` [12]."""
    for entry in range(12):
        map_[entry] = 0.0
    for slot in range(indices.shape[1]):
        weight = weights[point, slot]
        for entry in range(12):
            map_[entry] += weight * affines[indices[point, slot], time, entry]


@inlined
def _frame(a0: float, a1: float, a2: float, b0: float, b1: float, b2: float) -> tuple[float, ...]:
    """Gram-Schmidt: both axes, the length of the first column, its part of the second, the length of the rest."""
    length = max(math.sqrt(a0 * a0 + a1 * a1 + a2 * a2), 1e-12)
    x0, x1, x2 = a0 / length, a1 / length, a2 / length
    along = x0 * b0 + x1 * b1 + x2 * b2
    u0, u1, u2 = b0 - along * x0, b1 - along * x1, b2 - along * x2
    rest = max(math.sqrt(u0 * u0 + u1 * u1 + u2 * u2), 1e-12)
    return x0, x1, x2, u0 / rest, u1 / rest, u2 / rest, length, along, rest


@inlined
def _quaternion(x0: float, x1: float, x2: float, y0: float, y1: float, y2: float) -> tuple[float, float, float, float]:
    """Of the rotation with these first two columns (wxyz)."""
    z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    if x0 + y1 + z2 > 0:
        s = 2 * math.sqrt(x0 + y1 + z2 + 1)
        return 0.25 * s, (y2 - z1) / s, (z0 - x2) / s, (x1 - y0) / s
    if x0 > y1 and x0 > z2:
        s = 2 * math.sqrt(1 + x0 - y1 - z2)
        return (y2 - z1) / s, 0.25 * s, (y0 + x1) / s, (z0 + x2) / s
    if y1 > z2:
        s = 2 * math.sqrt(1 + y1 - x0 - z2)
        return (z0 - x2) / s, (y0 + x1) / s, 0.25 * s, (z1 + y2) / s
    s = 2 * math.sqrt(1 + z2 - x0 - y1)
    return (x1 - y0) / s, (z0 + x2) / s, (z1 + y2) / s, 0.25 * s


@inlined
def _product(
    pw: float, px: float, py: float, pz: float, qw: float, qx: float, qy: float, qz: float
) -> tuple[float, float, float, float]:
    """Hamilton's."""
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


@inlined
def _write_moved(map_: ndarray, positions: ndarray, moved: ndarray, time: int, point: int) -> None:
    """Where a map [12] takes a point."""
    x, y, z = positions[time, point]
    for axis in range(3):
        row = 4 * axis
        moved[time, point, axis] = map_[row] * x + map_[row + 1] * y + map_[row + 2] * z + map_[row + 3]


@inlined
def _write_turned(
    pw: float, px: float, py: float, pz: float, quats: ndarray, turned: ndarray, time: int, point: int
) -> None:
    """How a point is turned after a rotation p."""
    qw, qx, qy, qz = quats[time, point]
    rw, rx, ry, rz = _product(pw, px, py, pz, qw, qx, qy, qz)
    turned[time, point, 0], turned[time, point, 1] = rw, rx
    turned[time, point, 2], turned[time, point, 3] = ry, rz


@compiled
def _forward(
    tickets: ndarray,
    affines: ndarray,
    weights: ndarray,
    indices: ndarray,
    positions: ndarray,
    quats: ndarray,
    moved: ndarray,
    turned: ndarray,
) -> None:
    """Of the blocks that this thread draws."""
    batch, count = positions.shape[:2]
    blocks = -(-count // POINTS_PER_TICKET)
    map_ = np.empty(12, np.float32)
    oriented = quats.shape[1] > 0
    ticket = take_ticket(tickets)
    while ticket < batch * blocks:
        time, block = ticket // blocks, ticket % blocks
        for point in range(block * POINTS_PER_TICKET, min(count, (block + 1) * POINTS_PER_TICKET)):
            _blended(map_, affines, weights, indices, time, point)
            _write_moved(map_, positions, moved, time, point)
            if oriented:
                a0, a1, a2, b0, b1, b2, _ = _columns(map_, indices, weights, affines, time, point)
                x0, x1, x2, y0, y1, y2, _, _, _ = _frame(a0, a1, a2, b0, b1, b2)
                pw, px, py, pz = _quaternion(x0, x1, x2, y0, y1, y2)
                _write_turned(pw, px, py, pz, quats, turned, time, point)
        ticket = take_ticket(tickets)


@compiled
def _backward(
    tickets: ndarray,
    affines: ndarray,
    weights: ndarray,
    indices: ndarray,
    positions: ndarray,
    quats: ndarray,
    moved: ndarray,
    turned: ndarray,
    to_affines: ndarray,
    to_weights: ndarray,
    to_positions: ndarray,
    to_quats: ndarray,
) -> None:
    """Gradients, given those of the results (`moved`, `turned`); of the maps, block by block, if there is room.

    A change w of the rotation (a rotation vector) changes the result q by (0, w) q / 2, so that the gradient of w is
    half the vector part of dq conj(q). Of the columns a and b = first and second, with axes x, y, z, |a| and the rest
    r of b beside x: w = x (db.z - (x.b) da.z / |a|) / r - y da.z / |a| + z da.y / |a|.
    """
    batch, count = positions.shape[:2]
    blocks = -(-count // POINTS_PER_TICKET)
    map_, to_map = np.empty(12, np.float32), np.empty(12, np.float32)
    oriented, learned = quats.shape[1] > 0, len(to_affines) > 0
    ticket = take_ticket(tickets)
    while ticket < batch * blocks:
        time, block = ticket // blocks, ticket % blocks
        for point in range(block * POINTS_PER_TICKET, min(count, (block + 1) * POINTS_PER_TICKET)):
            _blended(map_, affines, weights, indices, time, point)
            g0, g1, g2 = moved[time, point]
            x, y, z = positions[time, point]
            for axis in range(3):
                to_positions[time, point, axis] = map_[axis] * g0 + map_[4 + axis] * g1 + map_[8 + axis] * g2
                g = moved[time, point, axis]
                row = 4 * axis
                to_map[row], to_map[row + 1], to_map[row + 2], to_map[row + 3] = g * x, g * y, g * z, g
            if oriented:
                a0, a1, a2, b0, b1, b2, single = _columns(map_, indices, weights, affines, time, point)
                x0, x1, x2, y0, y1, y2, length, along, rest = _frame(a0, a1, a2, b0, b1, b2)
                pw, px, py, pz = _quaternion(x0, x1, x2, y0, y1, y2)
                _write_turned(pw, -px, -py, -pz, turned, to_quats, time, point)
                if not learned:
                    continue
                gw, gx, gy, gz = turned[time, point]
                z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
                qw, qx, qy, qz = quats[time, point]
                rw, rx, ry, rz = _product(pw, px, py, pz, qw, qx, qy, qz)
                _, wx, wy, wz = _product(gw, gx, gy, gz, rw, -rx, -ry, -rz)
                about_x = 0.5 * (wx * x0 + wy * x1 + wz * x2)
                about_y = 0.5 * (wx * y0 + wy * y1 + wz * y2)
                about_z = 0.5 * (wx * z0 + wy * z1 + wz * z2)
                of_b = about_x / rest
                of_a = -(about_x * along / rest + about_y) / length
                by_y = about_z / length
                if single < 0:
                    to_map[0] += of_a * z0 + by_y * y0
                    to_map[4] += of_a * z1 + by_y * y1
                    to_map[8] += of_a * z2 + by_y * y2
                    to_map[1] += of_b * z0
                    to_map[5] += of_b * z1
                    to_map[9] += of_b * z2
                else:
                    to_affines[ticket, single, 0] += of_a * z0 + by_y * y0
                    to_affines[ticket, single, 4] += of_a * z1 + by_y * y1
                    to_affines[ticket, single, 8] += of_a * z2 + by_y * y2
                    to_affines[ticket, single, 1] += of_b * z0
                    to_affines[ticket, single, 5] += of_b * z1
                    to_affines[ticket, single, 9] += of_b * z2
            for slot in range(indices.shape[1] if learned else 0):
                basis, weight = indices[point, slot], weights[point, slot]
                total = np.float32(0)
                for entry in range(12):
                    total += to_map[entry] * affines[basis, time, entry]
                    to_affines[ticket, basis, entry] += weight * to_map[entry]
                to_weights[time, point, slot] = total
        ticket = take_ticket(tickets)


@compiled
def _add_level(
    tickets: ndarray, affines: ndarray, weights: ndarray, indices: ndarray, maps: ndarray, turns: ndarray
) -> None:
    """Of the blocks that this thread draws."""
    batch, count = maps.shape[:2]
    blocks = -(-count // POINTS_PER_TICKET)
    map_, before = np.empty(12, np.float32), np.empty(12, np.float32)
    ticket = take_ticket(tickets)
    while ticket < batch * blocks:
        time, block = ticket // blocks, ticket % blocks
        for point in range(block * POINTS_PER_TICKET, min(count, (block + 1) * POINTS_PER_TICKET)):
            _blended(map_, affines, weights, indices, time, point)
            for entry in range(12):
                before[entry] = maps[time, point, entry]
            for row in range(0, 12, 4):
                for column in range(4):
                    total = map_[row] * before[column] + map_[row + 1] * before[4 + column]
                    total += map_[row + 2] * before[8 + column]
                    maps[time, point, row + column] = total + (map_[row + 3] if column == 3 else np.float32(0))
            a0, a1, a2, b0, b1, b2, _ = _columns(map_, indices, weights, affines, time, point)
            x0, x1, x2, y0, y1, y2, _, _, _ = _frame(a0, a1, a2, b0, b1, b2)
            pw, px, py, pz = _quaternion(x0, x1, x2, y0, y1, y2)
            _write_turned(pw, px, py, pz, turns, turns, time, point)
        ticket = take_ticket(tickets)


@compiled
def _apply(
    tickets: ndarray,
    maps: ndarray,
    turns: ndarray,
    positions: ndarray,
    quats: ndarray,
    moved: ndarray,
    turned: ndarray,
) -> None:
    """Of the blocks that this thread draws."""
    batch, count = maps.shape[:2]
    blocks = -(-count // POINTS_PER_TICKET)
    ticket = take_ticket(tickets)
    while ticket < batch * blocks:
        time, block = ticket // blocks, ticket % blocks
        for point in range(block * POINTS_PER_TICKET, min(count, (block + 1) * POINTS_PER_TICKET)):
            _write_moved(maps[time, point], positions, moved, time, point)
            pw, px, py, pz = turns[time, point]
            _write_turned(pw, px, py, pz, quats, turned, time, point)
        ticket = take_ticket(tickets)


@compiled
def _apply_back(
    tickets: ndarray,
    maps: ndarray,
    turns: ndarray,
    moved: ndarray,
    turned: ndarray,
    to_positions: ndarray,
    to_quats: ndarray,
) -> None:
    """Gradients, given those of the results (`moved`, `turned`)."""
    batch, count = maps.shape[:2]
    blocks = -(-count // POINTS_PER_TICKET)
    ticket = take_ticket(tickets)
    while ticket < batch * blocks:
        time, block = ticket // blocks, ticket % blocks
        for point in range(block * POINTS_PER_TICKET, min(count, (block + 1) * POINTS_PER_TICKET)):
            map_ = maps[time, point]
            g0, g1, g2 = moved[time, point]
            for axis in range(3):
                to_positions[time, point, axis] = map_[axis] * g0 + map_[4 + axis] * g1 + map_[8 + axis] * g2
            pw, px, py, pz = turns[time, point]
            _write_turned(pw, -px, -py, -pz, turned, to_quats, time, point)
        ticket = take_ticket(tickets)
