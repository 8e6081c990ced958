"""The CPU rasterizer renders what the reference renders, and its gradients are the reference's."""

from typing import Any

import pytest
import torch

from lerobot_msdyn.render import rasterize


def assert_agrees(result, pixels_off=1e-4, gradient=1e-5):
    assert result.off <= pixels_off
    assert max(result.gradients) <= gradient, result.gradients


@pytest.mark.parametrize("channels", [1, 3, 4, 7, 8, 12, 16])
def test_any_number_of_channels(make_scene, compare_with_reference, channels):
    assert_agrees(compare_with_reference(make_scene(channels=channels)), pixels_off=1e-3)


@pytest.mark.parametrize("size", [(5, 64), (63, 33), (64, 32), (65, 31), (130, 70)])
def test_odd_sizes(make_scene, compare_with_reference, size):
    assert_agrees(compare_with_reference(make_scene(count=150, width=size[0], height=size[1])), pixels_off=1e-3)


@pytest.mark.parametrize("size", [(1, 1), (2, 3)])
def test_images_of_a_few_pixels(make_scene, compare_with_reference, size):
    # gradients are sums of a few cancelling terms: the reference in float32 is off by 1e-4 as well
    scene = make_scene(count=150, width=size[0], height=size[1])
    assert_agrees(compare_with_reference(scene), gradient=5e-4)


def test_a_dense_scene(make_scene, compare_with_reference):
    assert_agrees(compare_with_reference(make_scene(count=5000, width=160, height=120, radius=2.0)))


@pytest.mark.parametrize("per_view", [(), (0,), (4,), (0, 1), (0, 1, 2, 3, 4)])
def test_batches_of_views_and_of_scenes(make_scene, compare_with_reference, per_view):
    scene = make_scene(views=3, per_view=per_view)
    assert_agrees(compare_with_reference(scene), pixels_off=1e-3)


def test_views_of_a_batch_equal_single_views(make_scene):
    scene = make_scene(views=3)
    together, _ = scene.render("cpu")
    for view in range(3):
        camera = (scene.poses[view : view + 1], scene.intrinsics[view : view + 1])
        arguments: Any = (*scene.gaussians, *camera, scene.width, scene.height)
        alone = rasterize(*arguments, backend="cpu")
        assert torch.equal(alone.features[0], together.features[view])
        assert torch.equal(alone.depth[0], together.depth[view])


def test_deep_stacks_of_nearly_opaque_gaussians(make_scene, compare_with_reference):
    # every pixel ends early, and the suffix sums of the backward pass cancel
    scene = make_scene(count=2000, radius=8.0, opacity=(0.97, 1.0))
    result = compare_with_reference(scene)
    assert result.off <= 1e-2
    assert max(result.gradients) <= 2e-5, result.gradients


def test_large_needles_and_specks(make_scene, compare_with_reference):
    scene = make_scene(count=60)
    scale = scene.gaussians[2]
    scale[:20] = torch.tensor([3.0, 1e-4, 1e-4])  # hundreds of pixels long, under one wide
    scale[20:40] = torch.tensor([0.0, 1e-30, 1e-8])
    scale[40:50] = 50.0  # the camera is inside
    assert_agrees(compare_with_reference(scene), pixels_off=1e-3, gradient=1e-2)


def test_scales_beyond_float32_are_not_rendered(make_scene):
    scene = make_scene(count=3)
    scene.gaussians[2][0] = 1e30
    scene.gaussians[0][1] = torch.tensor([1e30, 0, 2.0])
    for backend in ("cpu", "reference"):
        raster, leaves = scene.render(backend)
        (raster.alpha.sum() + raster.depth.sum()).backward()
        assert all(leaf.grad.isfinite().all() for leaf in leaves)
    other = make_scene(count=3)
    other.gaussians[3][:2] = 0
    torch.testing.assert_close(scene.render("cpu")[0].alpha, other.render("cpu")[0].alpha)


def test_gaussians_behind_the_camera_get_no_gradient(make_scene):
    scene = make_scene(count=4)
    scene.gaussians[0][:2, 2] *= -1
    raster, leaves = scene.render("cpu")
    raster.alpha.sum().backward()
    assert leaves[0].grad[:2].abs().max() == 0
    assert leaves[0].grad[2:].abs().max() > 0


def test_an_empty_scene(make_scene):
    raster, leaves = make_scene(count=0, views=2, channels=5).render("cpu")
    assert raster.features.shape == (2, 45, 77, 5)
    assert raster.alpha.abs().max() == 0
    (raster.depth.sum() + raster.features.sum()).backward()
    assert leaves[0].grad.shape == (0, 3)
    assert leaves[5].grad.abs().max() == 0


def test_depth_is_zero_where_nothing_is_rendered(make_scene):
    raster, _ = make_scene(count=5).render("cpu")
    nothing = raster.alpha == 0
    assert nothing.any()
    assert not nothing.all()
    assert (raster.depth[nothing] == 0).all()
    assert (raster.depth[~nothing] > 0.9).all()


def test_only_some_outputs_and_inputs_take_part(make_scene):
    scene = make_scene()
    means, quats, scales, opacities, features = scene.gaussians
    features = features.clone().requires_grad_()
    raster = rasterize(
        means, quats, scales, opacities, features, scene.poses, scene.intrinsics, scene.width, scene.height,
        backend="cpu",
    )  # fmt: skip
    raster.features.sum().backward()
    everything, leaves = scene.render("cpu")
    everything.features.sum().backward()
    assert torch.equal(features.grad, leaves[4].grad)
    assert means.grad is None


def test_tensors_need_not_be_contiguous(make_scene):
    scene = make_scene(views=2)
    means, quats, scales, opacities, features = scene.gaussians
    strided = (means.T.contiguous().T, quats[:, None].expand(-1, 2, -1)[:, 0], scales, opacities, features)
    expanded = (*strided[:4], features[None].expand(2, *features.shape))
    poses = scene.poses.transpose(1, 2).contiguous().transpose(1, 2)
    raster = rasterize(*expanded, poses, scene.intrinsics, scene.width, scene.height, backend="cpu")
    assert torch.equal(raster.features, scene.render("cpu")[0].features)
