"""Composition of levels, and blending of bases."""

import dataclasses
import math

import torch
from torch import Tensor

from lerobot_msdyn.core.geometry import axis_angle_to_matrix, quaternion_to_matrix, se3
from lerobot_msdyn.motion.model.bases import MotionLevel, identity_level, level_affines, level_from_motions
from lerobot_msdyn.motion.model.compose import compose


def turn_about(point: Tensor, axis_angle: Tensor) -> Tensor:
    """Rotation about a point, as a motion [4,4]."""
    rotation = axis_angle_to_matrix(axis_angle)
    return se3(rotation, point - rotation @ point)


def random_level(bases: int, frames: int, seed: int) -> MotionLevel:
    generator = torch.Generator().manual_seed(seed)
    rotations = axis_angle_to_matrix(0.3 * torch.randn(bases, frames, 3, generator=generator))
    motions = se3(rotations, 0.1 * torch.randn(bases, frames, 3, generator=generator))
    motions[:, 0] = torch.eye(4)
    return level_from_motions(motions, torch.randn(bases, 3, generator=generator))


def some_gaussians(n: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(9)
    quats = torch.nn.functional.normalize(torch.randn(n, 4, generator=generator), dim=-1)
    return torch.randn(n, 3, generator=generator), quats


def test_nothing_moves_at_the_canonical_frame() -> None:
    means, quats = some_gaussians(6)
    levels = (random_level(2, 3, 0), random_level(4, 3, 1))
    indices = (torch.tensor([[0, 1]] * 6), torch.tensor([[3, 1, 2]] * 6))
    logits = (torch.randn(6, 2), torch.randn(6, 3))
    x, q = compose(means, quats, levels, indices, logits, torch.tensor([0]))
    torch.testing.assert_close(x[0], means)
    torch.testing.assert_close(quaternion_to_matrix(q[0]), quaternion_to_matrix(quats))


def test_fine_levels_are_carried_by_coarse_ones() -> None:
    fine, coarse = random_level(1, 2, 0), random_level(1, 2, 1)
    means, quats = some_gaussians(4)
    index, logit = torch.zeros(4, 1, dtype=torch.long), torch.zeros(4, 1)
    x, q = compose(means, quats, (coarse, fine), (index, index), (logit, logit), torch.tensor([1]))
    first, then = (level_affines(level, torch.tensor([1]))[0, 0] for level in (fine, coarse))
    expected = (means @ first[:, :3].T + first[:, 3]) @ then[:, :3].T + then[:, 3]
    torch.testing.assert_close(x[0], expected)
    torch.testing.assert_close(
        quaternion_to_matrix(q[0]), then[:, :3] @ first[:, :3] @ quaternion_to_matrix(quats), atol=1e-5, rtol=0
    )


def test_positions_do_not_depend_on_the_worlds_origin() -> None:
    shift = torch.tensor([10.0, -10.0, 10.0])
    level = random_level(3, 2, 5)
    means, quats = some_gaussians(5)
    index, logit = torch.tensor([[0, 1], [1, 2], [2, 0], [0, 2], [1, 0]]), torch.randn(5, 2)
    x, _ = compose(means, quats, (level,), (index,), (logit,), torch.tensor([1]))
    moved = dataclasses.replace(level, pivots=level.pivots + shift)
    y, _ = compose(means + shift, quats, (moved,), (index,), (logit,), torch.tensor([1]))
    torch.testing.assert_close(y - shift, x, atol=2e-5, rtol=0)


def test_a_point_on_a_hinge_stays() -> None:
    """Two bases that turn by +20 and -20 degrees about a common hinge, mixed half and half (docs/motion.md)."""
    hinge = torch.tensor([0.7, 0.0, 0.0])
    angle = torch.tensor([0.0, 0.0, math.radians(20)])
    motions = torch.stack((turn_about(hinge, angle), turn_about(hinge, -angle)))[:, None]
    level = level_from_motions(motions, torch.tensor([[0.6, 0.1, 0.0], [0.8, -0.2, 0.0]]))
    x, q = compose(
        hinge[None],
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        (level,),
        (torch.tensor([[0, 1]]),),
        (torch.zeros(1, 2),),
        torch.tensor([0]),
    )
    torch.testing.assert_close(x[0, 0], hinge)
    torch.testing.assert_close(quaternion_to_matrix(q[0, 0]), torch.eye(3))  # the two rotations cancel


def test_opposite_rotations_fall_back_to_the_heavier_basis() -> None:
    turns = torch.tensor([[0.0, 0.0, math.pi], [0.0, 0.0, 0.0]])
    motions = torch.stack([turn_about(torch.zeros(3), turn) for turn in turns])[:, None]
    level = level_from_motions(motions, torch.zeros(2, 3))
    logits = torch.tensor([[1e-4, 0.0]], requires_grad=True)
    means, quats = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    x, q = compose(means, quats, (level,), (torch.tensor([[0, 1]]),), (logits,), torch.tensor([0]))
    torch.testing.assert_close(quaternion_to_matrix(q[0, 0]), torch.diag(torch.tensor([-1.0, -1.0, 1.0])))
    (x.sum() + q.sum()).backward()
    assert logits.grad is not None
    assert logits.grad.isfinite().all()


def test_several_frames_at_once_equal_one_by_one() -> None:
    level = random_level(3, 4, 2)
    means, quats = some_gaussians(7)
    index, logit = torch.randint(0, 3, (7, 2), generator=torch.Generator().manual_seed(0)), torch.randn(7, 2)
    x, q = compose(means, quats, (level,), (index,), (logit,), torch.tensor([3, 1]))
    for row, frame in enumerate((3, 1)):
        one_x, one_q = compose(means, quats, (level,), (index,), (logit,), torch.tensor([frame]))
        torch.testing.assert_close(x[row], one_x[0])
        torch.testing.assert_close(q[row], one_q[0])


def test_gradients_match_finite_differences() -> None:
    level = random_level(3, 2, 3)
    means, quats = (t.double() for t in some_gaussians(4))
    index = torch.tensor([[0, 1], [1, 2], [2, 0], [0, 2]])
    logits = torch.randn(4, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    def positions(means: Tensor, rotations: Tensor, displacements: Tensor, logits: Tensor) -> Tensor:
        moved = dataclasses.replace(
            level,
            rotations_6d=rotations,
            displacements=displacements,
            pivots=level.pivots.double(),
            knots=level.knots.double(),
        )
        x, q = compose(means, quats, (moved,), (index,), (logits,), torch.tensor([1]))
        return torch.cat((x, q), dim=-1)

    arguments = (means, level.rotations_6d.double(), level.displacements.double(), logits)
    assert torch.autograd.gradcheck(positions, [a.detach().requires_grad_(True) for a in arguments])


def test_no_gaussians_and_no_levels() -> None:
    level = identity_level(torch.zeros(1, 3), 2)
    none = torch.zeros(0, 1, dtype=torch.long)
    x, q = compose(torch.zeros(0, 3), torch.zeros(0, 4), (level,), (none,), (torch.zeros(0, 1),), torch.tensor([0, 1]))
    assert x.shape == (2, 0, 3)
    assert q.shape == (2, 0, 4)
    means, quats = some_gaussians(3)
    x, q = compose(means, quats, (), (), (), torch.tensor([0, 1]))
    torch.testing.assert_close(x, means.expand(2, -1, -1))
    torch.testing.assert_close(q, quats.expand(2, -1, -1))


def test_the_few_bases_that_are_named_equal_all_of_them_with_no_weight() -> None:
    """Sparse equals dense: what a point does not name has no weight, so naming all bases gives the same."""
    level = random_level(6, 3, 4)
    means, quats = some_gaussians(8)
    generator = torch.Generator().manual_seed(2)
    few = torch.stack([torch.randperm(6, generator=generator)[:3] for _ in range(8)])
    logits = torch.randn(8, 3, generator=generator)
    every = torch.arange(6).expand(8, 6)
    dense = torch.full((8, 6), -torch.inf).scatter_(1, few, logits)
    times = torch.tensor([0, 1, 2])
    sparse = compose(means, quats, (level,), (few,), (logits,), times)
    full = compose(means, quats, (level,), (every,), (dense,), times)
    for one, other in zip(sparse, full, strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)
    permuted = torch.tensor([2, 0, 1])
    again = compose(means, quats, (level,), (few[:, permuted],), (logits[:, permuted],), times)
    torch.testing.assert_close(again[0], sparse[0], atol=1e-6, rtol=1e-5)


def test_every_gaussian_moves_rigidly_at_its_centre() -> None:
    """The pair of position and orientation is a motion in SE(3) of each Gaussian, blends included."""
    level = random_level(3, 2, 6)
    means, quats = some_gaussians(5)
    index, logit = torch.tensor([[0, 1, 2]] * 5), torch.randn(5, 3, generator=torch.Generator().manual_seed(3))
    _, q = compose(means, quats, (level,), (index,), (logit,), torch.tensor([1]))
    R = quaternion_to_matrix(q[0])
    torch.testing.assert_close(R @ R.transpose(1, 2), torch.eye(3).expand(5, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(5), atol=1e-5, rtol=0)


def carried_and_gradients(level: MotionLevel, kind: torch.dtype) -> list[Tensor]:
    """What 3 bases of each point make of it in the given precision, and the gradients of all that is learned."""
    cast = {name: getattr(level, name).to(kind) for name in ("knots", "pivots", "reach")}
    learned = {name: getattr(level, name).to(kind, copy=True) for name in ("rotations_6d", "displacements")}
    for each in learned.values():
        each.requires_grad_()
    level = dataclasses.replace(level, **cast, **learned)
    generator = torch.Generator().manual_seed(4)
    n, times = 5000, torch.tensor([0, 2, 1])
    indices = torch.randint(len(level), (n, 3), generator=generator)
    logits, points = (torch.randn(n, 3, generator=generator).to(kind).requires_grad_() for _ in range(2))
    quats = torch.randn(n, 4, generator=generator).to(kind).requires_grad_()
    x, q = level.carry(points.expand(3, -1, -1), quats.expand(3, -1, -1), indices, logits, times)
    towards = torch.randn(3, n, 4, generator=generator).to(kind)
    turned = (q * towards).sum(-1).square()  # of a quaternion the sign is free
    ((x * towards[..., :3]).sum() + turned.sum()).backward()
    given = (*learned.values(), logits, points, quats)
    return [x, turned, *(each.grad for each in given if each.grad is not None)]


def test_the_compiled_route_equals_torch_in_double_precision() -> None:
    level = random_level(6, 3, 7)
    compiled, plain = carried_and_gradients(level, torch.float32), carried_and_gradients(level, torch.float64)
    assert len(compiled) == len(plain) == 7
    for one, other in zip(compiled, plain, strict=True):
        torch.testing.assert_close(one.double(), other, atol=3e-5 * float(other.detach().abs().max()), rtol=0)
    points = torch.randn(2, 5000, 3)
    indices, logits, times = torch.randint(6, (5000, 2)), torch.randn(5000, 2), torch.tensor([1, 2])
    both = level.carry(points, torch.randn(2, 5000, 4), indices, logits, times)[0]
    assert torch.equal(level.carry_points(points, indices, logits, times), both)


def test_opposite_bases_have_the_same_gradients_by_both_routes() -> None:
    """Where blended rotations cancel out, the heaviest basis alone turns the point and learns from it."""
    still = torch.eye(4)
    motions = torch.stack((still, turn_about(torch.zeros(3), torch.tensor([math.pi, 0.0, 0.0]))))
    gradients = []
    for kind in (torch.float32, torch.float64):
        level = level_from_motions(motions[:, None].to(kind), torch.zeros(2, 3, dtype=kind))
        sixd = level.rotations_6d.clone().requires_grad_()
        level = dataclasses.replace(level, rotations_6d=sixd)
        quats = torch.tensor([[0.5, 0.1, -0.7, 0.4]], dtype=kind)
        points = torch.tensor([[0.1, 0.2, 0.3]], dtype=kind)
        logits = torch.tensor([[0.0, 1e-5]], dtype=kind)
        _, q = level.carry(points[None], quats[None], torch.tensor([[0, 1]]), logits, torch.tensor([0]))
        (q * torch.tensor([0.3, -0.2, 0.9, 0.4], dtype=kind)).sum().square().backward()
        assert sixd.grad is not None
        assert bool((sixd.grad[0] == 0).all())
        gradients.append(sixd.grad.double())
    torch.testing.assert_close(*gradients, atol=1e-5, rtol=0)
