"""Rigid motions, projection and Procrustes against values worked out by hand."""

import math

import pytest
import torch

from lerobot_msdyn.core import geometry as g


def random_motion(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return g.se3(
        g.axis_angle_to_matrix(torch.randn(3, generator=generator, dtype=torch.float64)),
        torch.randn(3, generator=generator, dtype=torch.float64),
    )


def test_quarter_turn_about_z() -> None:
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    half = math.sqrt(0.5)
    torch.testing.assert_close(g.quaternion_to_matrix(torch.tensor([half, 0, 0, half])), quarter)
    torch.testing.assert_close(g.axis_angle_to_matrix(torch.tensor([0, 0, math.pi / 2])), quarter)
    torch.testing.assert_close(g.matrix_to_quaternion(quarter), torch.tensor([half, 0, 0, half]))
    torch.testing.assert_close(g.rotation_6d_to_matrix(g.matrix_to_rotation_6d(quarter)), quarter)


def test_quaternions_of_any_length_give_rotations() -> None:
    quat = torch.tensor([0.3, -0.2, 0.5, 0.1])
    torch.testing.assert_close(g.quaternion_to_matrix(7 * quat), g.quaternion_to_matrix(quat))


def test_quaternion_product_composes_rotations() -> None:
    p, q = torch.randn(2, 4, generator=torch.Generator().manual_seed(0))
    expected = g.quaternion_to_matrix(p) @ g.quaternion_to_matrix(q)
    torch.testing.assert_close(g.quaternion_to_matrix(g.quaternion_multiply(p, q)), expected)


def test_inverse_undoes_a_motion() -> None:
    motion = random_motion(1)
    torch.testing.assert_close(motion @ g.invert_se3(motion), torch.eye(4, dtype=torch.float64))


def test_projection_of_a_known_point() -> None:
    intrinsics = torch.tensor([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])
    xy, z = g.project(torch.tensor([[0.5, -0.25, 2.0]]), intrinsics)
    torch.testing.assert_close(xy, torch.tensor([[57.0, 11.5]]))
    torch.testing.assert_close(z, torch.tensor([2.0]))
    torch.testing.assert_close(g.unproject(xy, z, intrinsics), torch.tensor([[0.5, -0.25, 2.0]]))


def test_pixel_centres_are_at_half_integers() -> None:
    assert g.pixel_grid(2, 3)[1, 2].tolist() == [2.5, 1.5]
    intrinsics = torch.tensor([[10.0, 0, 1.5], [0, 10, 1], [0, 0, 1]])
    points = g.unproject_image(torch.full((2, 3), 4.0), intrinsics)
    torch.testing.assert_close(points[0, 1], torch.tensor([0.0, -0.2, 4.0]))


@pytest.mark.parametrize("seed", range(3))
def test_procrustes_recovers_a_motion(seed: int) -> None:
    motion = random_motion(seed)
    source = torch.randn(20, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    target = g.transform_points(motion, source)
    torch.testing.assert_close(g.weighted_procrustes(source, target, torch.ones(20, dtype=torch.float64)), motion)


def test_procrustes_ignores_points_without_weight() -> None:
    motion = random_motion(3)
    source = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    target = g.transform_points(motion, source)
    target[:5] += 10
    weights = torch.ones(20, dtype=torch.float64)
    weights[:5] = 0
    torch.testing.assert_close(g.weighted_procrustes(source, target, weights), motion)


@pytest.mark.parametrize("flat", [False, True])
def test_procrustes_never_reflects(flat: bool) -> None:
    source = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    if flat:
        source[:, 2] = 0
    pose = g.weighted_procrustes(source, source * torch.tensor([1.0, 1, -1]), torch.ones(20))
    torch.testing.assert_close(torch.linalg.det(pose[:3, :3]), torch.tensor(1.0))
    if flat:
        torch.testing.assert_close(g.transform_points(pose, source), source, atol=1e-5, rtol=1e-5)


def test_a_quaternion_and_its_conjugate_undo_each_other() -> None:
    quats = torch.nn.functional.normalize(torch.randn(6, 4, generator=torch.Generator().manual_seed(0)), dim=-1)
    expected = torch.tensor([1.0, 0, 0, 0]).expand(6, 4)
    torch.testing.assert_close(g.quaternion_multiply(quats, g.quaternion_conjugate(quats)), expected)


@pytest.mark.parametrize("spread", [(1.0, 1.0, 1.0), (1.0, 0.5, 1e-3), (1.0, 1e-2, 0.0), (2.0, 1.0, -0.3)])
def test_nearest_rotation_is_that_of_singular_vectors(spread: tuple[float, float, float]) -> None:
    """The compiled route against the other one, also for flat, thin and reflected sets."""
    turns = torch.linalg.qr(torch.randn(2, 50, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))[
        0
    ]
    left, right = turns * torch.linalg.det(turns).sign()[..., None, None]
    matrices = left @ torch.diag(torch.tensor(spread, dtype=torch.float64)) @ right.transpose(1, 2)
    found, expected = g.nearest_rotation(matrices), g.nearest_rotation(matrices.requires_grad_()).detach()
    torch.testing.assert_close(found, expected, atol=1e-9, rtol=0)
    torch.testing.assert_close(found, left @ right.transpose(1, 2), atol=1e-9, rtol=0)


def test_nearest_pixels() -> None:
    row, column = g.nearest_pixel(torch.tensor([[0.0, 0.0], [2.99, 1.01], [-0.3, 7.0], [3.0, -9.0]]), 3, 2)
    assert (row.tolist(), column.tolist()) == ([0, 1, 1, 0], [0, 2, 0, 2])
