"""Rigid motions, projection and Procrustes: pure functions on tensors.

Conventions: OpenCV camera axes (x right, y down, z forward), pixel centres at half-integers, metres, quaternions
wxyz, transforms named `a_from_b` so that `a_from_b @ b_from_c` reads as it works.
"""

import torch
from jaxtyping import Float, Int
from kornia.geometry.conversions import (
    axis_angle_to_rotation_matrix,
    quaternion_to_rotation_matrix,
    rotation_matrix_to_axis_angle,
    rotation_matrix_to_quaternion,
)
from torch import Tensor


def quaternion_to_matrix(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions wxyz of any length but zero."""
    return quaternion_to_rotation_matrix(quats)


def matrix_to_quaternion(rotations: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions wxyz of rotation matrices."""
    return rotation_matrix_to_quaternion(rotations.contiguous())


def axis_angle_to_matrix(axis_angle: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of rotation vectors (direction = axis, length = angle in radians)."""
    flat = axis_angle_to_rotation_matrix(axis_angle.reshape(-1, 3))
    return flat.reshape(*axis_angle.shape[:-1], 3, 3)


def matrix_to_axis_angle(rotations: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotation vectors of rotation matrices."""
    return rotation_matrix_to_axis_angle(rotations.reshape(-1, 3, 3)).reshape(*rotations.shape[:-2], 3)


def rotation_6d_to_matrix(sixd: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices from their first two COLUMNS, orthonormalised (Gram-Schmidt; Zhou et al. 2019)."""
    first, second = sixd[..., :3], sixd[..., 3:]
    x = torch.nn.functional.normalize(first, dim=-1)
    y = torch.nn.functional.normalize(second - (x * second).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack((x, y, torch.linalg.cross(x, y)), dim=-1)


def matrix_to_rotation_6d(rotations: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 6"]:
    """First two columns of rotation matrices."""
    return torch.cat((rotations[..., :, 0], rotations[..., :, 1]), dim=-1)


def quaternion_multiply(p: Float[Tensor, "*#batch 4"], q: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Hamilton product of quaternions wxyz; rotates by q first, then by p."""
    pw, px, py, pz = p.unbind(-1)
    qw, qx, qy, qz = q.unbind(-1)
    return torch.stack(
        (
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ),
        dim=-1,
    )


def quaternion_conjugate(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Opposite rotations of unit quaternions wxyz."""
    return quats * quats.new_tensor([1.0, -1.0, -1.0, -1.0])


def se3(rotation: Float[Tensor, "*batch 3 3"], translation: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4 4"]:
    """Homogeneous matrices [R | t; 0 1]."""
    out = torch.zeros(*translation.shape[:-1], 4, 4, dtype=translation.dtype, device=translation.device)
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1
    return out


def invert_se3(a_from_b: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Inverse of rigid motions, exact in the rotation part."""
    rotation = a_from_b[..., :3, :3].transpose(-1, -2)
    return se3(rotation, -(rotation @ a_from_b[..., :3, 3:])[..., 0])


def transform_points(
    a_from_b: Float[Tensor, "*batch 4 4"], points: Float[Tensor, "*batch n 3"]
) -> Float[Tensor, "*batch n 3"]:
    """Points of frame b expressed in frame a."""
    return points @ a_from_b[..., :3, :3].transpose(-1, -2) + a_from_b[..., None, :3, 3]


def project(
    points: Float[Tensor, "*batch n 3"], intrinsics: Float[Tensor, "*batch 3 3"]
) -> tuple[Float[Tensor, "*batch n 2"], Float[Tensor, "*batch n"]]:
    """Pixel coordinates and z-depth of points in camera coordinates; no clipping, z is floored at 1e-6 m."""
    z = points[..., 2]
    homogeneous = points @ intrinsics.transpose(-1, -2)
    return homogeneous[..., :2] / z.clamp(min=1e-6)[..., None], z


def unproject(
    xy: Float[Tensor, "*batch n 2"], depth: Float[Tensor, "*batch n"], intrinsics: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch n 3"]:
    """Camera-space points of pixels `xy` at z-depth `depth`."""
    rays = torch.cat((xy, torch.ones_like(xy[..., :1])), dim=-1) @ torch.linalg.inv(intrinsics).transpose(-1, -2)
    return rays * depth[..., None]


def nearest_pixel(xy: Float[Tensor, "*n 2"], width: int, height: int) -> tuple[Int[Tensor, "*n"], Int[Tensor, "*n"]]:
    """Row and column of the pixel that holds each image point (px); of the nearest one of the border if none does."""
    column, row = xy.floor().long().unbind(-1)
    return row.clamp(0, height - 1), column.clamp(0, width - 1)


def pixel_grid(height: int, width: int, device: torch.device | str = "cpu") -> Float[Tensor, "height width 2"]:
    """Pixel centres (x, y), at half-integers."""
    y, x = torch.meshgrid(
        torch.arange(height, device=device) + 0.5, torch.arange(width, device=device) + 0.5, indexing="ij"
    )
    return torch.stack((x, y), dim=-1).float()


def unproject_image(
    depth: Float[Tensor, "height width"], intrinsics: Float[Tensor, "3 3"]
) -> Float[Tensor, "height width 3"]:
    """Camera-space point of every pixel of a z-depth image."""
    height, width = depth.shape
    xy = pixel_grid(height, width, depth.device).reshape(-1, 2).to(depth.dtype)
    return unproject(xy, depth.reshape(-1), intrinsics).reshape(height, width, 3)


def nearest_rotation(matrices: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotations R that maximise trace(R^T M); reflections are excluded by the determinant's sign (Kabsch-Umeyama).

    Solved in float64: single precision loses the smallest singular vectors of thin sets.
    """
    if not (matrices.is_cuda or matrices.requires_grad):
        from lerobot_msdyn.core.rotations import nearest_rotations  # takes a while to import

        flat = matrices.double().reshape(-1, 3, 3).contiguous().numpy()
        return torch.from_numpy(nearest_rotations(flat)).reshape(matrices.shape).to(matrices.dtype)
    u, _, vt = torch.linalg.svd(matrices.double())
    sign = torch.ones(*matrices.shape[:-1], dtype=torch.float64, device=matrices.device)
    sign[..., 2] = torch.linalg.det(u @ vt).sign()
    return ((u * sign[..., None, :]) @ vt).to(matrices.dtype)


def weighted_procrustes(
    source: Float[Tensor, "*batch n 3"],
    target: Float[Tensor, "*batch n 3"],
    weights: Float[Tensor, "*batch n"],
) -> Float[Tensor, "*batch 4 4"]:
    """Rigid motion that best carries `source` onto `target` in the weighted least-squares sense (Kabsch-Umeyama).

    Solved in float64; reflections are excluded by the determinant's sign. Weights need not be normalised, and
    must not all be zero.
    """
    w = (weights / weights.sum(-1, keepdim=True).clamp(min=1e-12)).double()[..., None]
    x, y = source.double(), target.double()
    x_mean, y_mean = (w * x).sum(-2, keepdim=True), (w * y).sum(-2, keepdim=True)
    rotation = nearest_rotation((w * (y - y_mean)).transpose(-1, -2) @ (x - x_mean))
    translation = y_mean[..., 0, :] - (rotation @ x_mean[..., 0, :, None])[..., 0]
    return se3(rotation, translation).to(source.dtype)
