"""What gsplat computes, by its own Python with its kernels in torch, is what the reference computes; no GPU is needed.

This holds the call (which argument means what, shapes, the order of channels) and the projection, which is gsplat's own
torch code, to the reference. The kernels themselves are run by tests/gpu alone.
"""

import inspect
from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_msdyn.render import Raster, rasterize, reference
from lerobot_msdyn.render.types import COVARIANCE_BLUR

pytest.importorskip("gsplat")

from gsplat_on_cpu import gsplat_on_cpu

from lerobot_msdyn.render import cuda

NEAR = 0.01


def leaves_of(scene, dtype=torch.float64) -> list[Tensor]:
    return [values.to(dtype).detach().clone().requires_grad_() for values in (*scene.gaussians, scene.poses)]


def by_gsplat(scene, near: float = NEAR) -> tuple[Raster, list[Tensor]]:
    leaves = leaves_of(scene)
    with gsplat_on_cpu():
        arguments: Any = (*leaves, scene.intrinsics.double(), scene.width, scene.height, near)
        raster = cuda.render_with_gsplat(*arguments)
    return raster, leaves


def by_reference(scene, near: float = NEAR) -> tuple[Raster, list[Tensor]]:
    leaves = leaves_of(scene)
    arguments: Any = (*leaves, scene.intrinsics.double(), scene.width, scene.height)
    return rasterize(*arguments, backend="reference", near=near), leaves


def assert_same(scene, near: float = NEAR) -> None:
    by_kernels, expected = by_gsplat(scene, near), by_reference(scene, near)
    generator = torch.Generator().manual_seed(0)
    for raster, leaves in (by_kernels, expected):
        generator.manual_seed(0)
        images = (raster.features, raster.depth, raster.alpha)
        incoming = [torch.randn(image.shape, generator=generator, dtype=torch.float64) for image in images]
        torch.autograd.backward(images, incoming)
        assert all(leaf.grad is not None for leaf in leaves)
    for name in ("features", "depth", "alpha"):
        torch.testing.assert_close(getattr(by_kernels[0], name), getattr(expected[0], name), rtol=1e-9, atol=1e-9)
    for mine, theirs in zip(by_kernels[1], expected[1], strict=True):
        torch.testing.assert_close(mine.grad, theirs.grad, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("per_view", [(), (0, 1, 4), (0, 1, 2, 3, 4)])
def test_pictures_and_gradients_of_a_batch(make_scene, per_view):
    assert_same(make_scene(count=30, width=37, height=23, views=2, per_view=per_view))


@pytest.mark.parametrize("channels", [1, 5, 40])  # gsplat renders more than 32 in several passes
def test_any_number_of_channels(make_scene, channels):
    assert_same(make_scene(count=20, width=19, height=17, channels=channels))


def test_saturated_pixels(make_scene):
    assert_same(make_scene(count=60, width=18, height=16, radius=6.0, opacity=(0.97, 1.0)))


def test_what_is_not_rendered(make_scene):
    scene = make_scene(count=25, width=20, height=18)
    means, _, scales, opacities, _ = scene.gaussians
    means[0, 2] = -1.0  # behind
    means[1] = torch.tensor([0.0, 0.0, 1e-3])  # before the near plane
    means[2] = torch.tensor([1e30, 0.0, 2.0])
    scales[3] = 1e30
    scales[4] = 0.0
    opacities[5], opacities[6] = 0.003, 0.0  # fainter than 1/255
    assert_same(scene)
    assert_same(scene, near=1.5)


def test_the_projection_alone(make_scene):
    from gsplat.cuda import _torch_impl

    scene = make_scene(count=200, views=2)
    means, quats, scales, opacities, features = (values.double() for values in scene.gaussians)
    poses, intrinsics = scene.poses.double(), scene.intrinsics.double()
    size = (scene.width, scene.height)
    covariances, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    _, centres, depths, conics, _ = _torch_impl._fully_fused_projection(
        means, covariances, poses, intrinsics, *size, eps2d=COVARIANCE_BLUR
    )
    splats = reference._project(means, quats, scales, opacities, features, poses, intrinsics, *size, NEAR)
    assert len(splats.depth) == depths.numel()
    inverse = torch.linalg.inv(splats.covariance)
    torch.testing.assert_close(centres.reshape(-1, 2), splats.center)
    torch.testing.assert_close(depths.reshape(-1), splats.depth)
    torch.testing.assert_close(conics.reshape(-1, 3), inverse[:, [0, 0, 1], [0, 1, 1]])
    torch.testing.assert_close(torch.linalg.det(splats.covariance), splats.determinant)


def test_values_are_checked_without_waiting(make_scene):
    scene = make_scene(count=8)
    arguments = [*scene.gaussians, scene.poses, scene.intrinsics]
    assert bool(cuda._usable(*arguments))
    for index, value in ((0, float("nan")), (1, 0.0), (2, -1.0), (3, 1.5), (3, float("nan")), (6, -1.0)):
        wrong = [values.clone() for values in arguments]
        wrong[index][0] = value
        assert not bool(cuda._usable(*wrong)), index


def test_the_installed_gsplat_takes_what_is_given():
    import gsplat

    given = {"near_plane", "eps2d", "packed", "render_mode", "rasterize_mode"}
    assert given <= set(inspect.signature(gsplat.rasterization).parameters)
