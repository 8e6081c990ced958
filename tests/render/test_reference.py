"""The reference rasterizer against values worked out by hand."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_msdyn.core.errors import RenderError
from lerobot_msdyn.render import rasterize

FOCAL = 10.0
SIZE = 9  # px; the centre pixel is (4, 4), its centre at (4.5, 4.5)


def render(means, opacities, features, scales=None, quats=None, camera=None, size=(SIZE, SIZE), **options):
    """Isotropic Gaussians in float64, seen by a camera at the origin that looks along +z."""
    width, height = size
    means = torch.as_tensor(means, dtype=torch.float64)
    count = len(means)
    scales = torch.full((count, 3), 0.2) if scales is None else torch.as_tensor(scales)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4) if quats is None else torch.as_tensor(quats)
    camera = torch.eye(4)[None] if camera is None else camera
    intrinsics = torch.tensor([[FOCAL, 0, width / 2], [0, FOCAL, height / 2], [0, 0, 1]])
    return rasterize(
        means,
        quats.double(),
        scales.double(),
        torch.as_tensor(opacities, dtype=torch.float64),
        torch.as_tensor(features, dtype=torch.float64),
        camera.double(),
        intrinsics.double().expand(len(camera), 3, 3),
        width,
        height,
        backend="reference",
        **options,
    )


def test_one_gaussian_has_its_opacity_at_its_centre_and_falls_off_as_a_gaussian():
    raster = render([[0, 0, 2.0]], [0.5], [[0.2, 0.6]])
    variance = (0.2 * FOCAL / 2) ** 2 + 0.3
    assert raster.alpha[0, 4, 4].item() == pytest.approx(0.5)
    assert raster.alpha[0, 4, 6].item() == pytest.approx(0.5 * math.exp(-0.5 * 4 / variance))
    assert raster.alpha[0, 5, 4].item() == pytest.approx(0.5 * math.exp(-0.5 * 1 / variance))
    torch.testing.assert_close(raster.features[0, 4, 4], torch.tensor([0.1, 0.3], dtype=torch.float64))
    assert raster.depth[0, 4, 4].item() == pytest.approx(2.0)


def test_alpha_below_one_255th_is_skipped():
    raster = render([[0, 0, 2.0]], [0.5], [[1.0]])
    variance = (0.2 * FOCAL / 2) ** 2 + 0.3
    reach = math.sqrt(2 * variance * math.log(255 * 0.5))  # 3.55 px: the pixel 3 away is in, 4 away is out
    assert 3 < reach < 4
    assert raster.alpha[0, 4, 7] > 1 / 255
    assert raster.alpha[0, 4, 8] == 0
    assert raster.depth[0, 4, 8] == 0


def test_anisotropic_rotated_gaussian_follows_the_projected_covariance():
    # 90 degrees about z: the long axis x of the Gaussian becomes the image's y
    half = math.sqrt(0.5)
    raster = render([[0, 0, 1.0]], [0.8], [[1.0]], scales=[[0.2, 0.05, 0.1]], quats=[[3 * half, 0, 0, 3 * half]])
    along_y = 0.8 * math.exp(-0.5 * 4 / ((0.2 * FOCAL) ** 2 + 0.3))
    along_x = 0.8 * math.exp(-0.5 * 4 / ((0.05 * FOCAL) ** 2 + 0.3))
    assert raster.alpha[0, 6, 4].item() == pytest.approx(along_y)
    assert raster.alpha[0, 4, 6].item() == pytest.approx(along_x)


def test_two_gaussians_blend_front_to_back_whatever_their_order():
    near, far = [0, 0, 1.0], [0, 0, 3.0]
    for order in ((0, 1), (1, 0)):
        means = [(near, far)[i] for i in order]
        opacities = [(0.6, 0.5)[i] for i in order]
        colors = [([1.0, 0.0], [0.0, 1.0])[i] for i in order]
        raster = render(means, opacities, colors)
        weights = torch.tensor([0.6, 0.4 * 0.5], dtype=torch.float64)
        torch.testing.assert_close(raster.features[0, 4, 4], weights)
        assert raster.alpha[0, 4, 4].item() == pytest.approx(0.8)
        assert raster.depth[0, 4, 4].item() == pytest.approx((0.6 * 1 + 0.2 * 3) / 0.8)


def test_alpha_is_capped_and_a_pixel_stops_before_it_is_opaque():
    # transmittance: 1 -> 0.001 -> 0.0005 -> (next would be 5e-7: stop) and nothing behind is rendered
    means = [[0, 0, 1.0], [0, 0, 2.0], [0, 0, 3.0], [0, 0, 4.0]]
    raster = render(means, [1.0, 0.5, 1.0, 0.3], torch.eye(4))
    expected = torch.tensor([0.999, 0.0005, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(raster.features[0, 4, 4], expected)
    assert raster.alpha[0, 4, 4].item() == pytest.approx(0.9995)


def test_no_gradient_flows_through_a_capped_alpha():
    opacity = torch.ones(1, dtype=torch.float64, requires_grad=True)
    render([[0, 0, 2.0]], opacity, [[1.0]]).alpha[0, 4, 4].backward()
    assert opacity.grad is not None
    assert opacity.grad.item() == 0


@pytest.mark.parametrize("z", [-1.0, 0.0, 0.01])
def test_gaussians_behind_or_at_the_near_plane_are_not_rendered(z):
    raster = render([[0, 0, z], [0, 0, 2.0]], [0.9, 0.5], [[1.0], [0.5]])
    assert raster.features[0, 4, 4, 0].item() == pytest.approx(0.25)


def test_the_near_plane_can_be_moved():
    assert render([[0, 0, 1.0]], [0.9], [[1.0]], near=1.5).alpha.max() == 0


def test_empty_scene_and_one_pixel_image():
    empty = render(torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 2))
    assert empty.features.shape == (1, SIZE, SIZE, 2)
    assert empty.alpha.abs().max() == 0
    assert empty.depth.abs().max() == 0
    pixel = render([[0, 0, 2.0]], [0.5], [[1.0]], size=(1, 1))
    assert pixel.alpha.shape == (1, 1, 1)
    assert pixel.alpha.item() == pytest.approx(0.5)


def test_views_see_the_scene_from_their_own_pose():
    shifted = torch.eye(4)
    shifted[0, 3] = 0.4  # camera 0.4 m to the left: at 2 m the Gaussian moves 2 px to the right
    raster = render([[0, 0, 2.0]], [0.5], [[1.0]], camera=torch.stack((torch.eye(4), shifted)))
    assert raster.alpha[0, 4, 4].item() == pytest.approx(0.5)
    assert raster.alpha[1, 4, 6].item() == pytest.approx(0.5)


def test_covariance_is_linearised_no_further_than_the_tangent_margin():
    # A Gaussian long in z far to the left of the image: unclamped, its smear in x would be f X sz / Z^2.
    raster = render([[-3.0, 0, 1.0]], [1.0], [[1.0]], scales=[[1e-6, 1e-6, 0.9]])
    limit = (SIZE / 2) / FOCAL * 1.3
    variance = (FOCAL * limit * 0.9) ** 2 + 0.3
    distance = 4.5 - (FOCAL * -3.0 + SIZE / 2)
    expected = math.exp(-0.5 * distance**2 / variance)
    assert raster.alpha[0, 4, 4].item() == pytest.approx(expected if expected >= 1 / 255 else 0.0)
    closer = render([[-1.0, 0, 1.0]], [1.0], [[1.0]], scales=[[1e-6, 1e-6, 0.9]])
    distance = 4.5 - (FOCAL * -1.0 + SIZE / 2)
    assert closer.alpha[0, 4, 4].item() == pytest.approx(math.exp(-0.5 * distance**2 / variance))


def test_gradients_of_all_gaussian_parameters_and_the_pose():
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape, low=0.0, high=1.0):
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    count, width, height = 5, 11, 10
    parameters = (
        torch.cat((uniform(count, 2, low=-0.4, high=0.4), uniform(count, 1, low=1.0, high=2.0)), 1),
        uniform(count, 4, low=-1, high=1),
        uniform(count, 3, low=0.05, high=0.15),
        uniform(count, low=0.2, high=0.8),
        uniform(count, 2),
    )
    camera = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    camera[1, 0, 3] = 0.1
    camera[:, :3, :3] += uniform(2, 3, 3, low=-0.02, high=0.02)
    intrinsics = torch.tensor([[12.0, 0, 5.5], [0, 13.0, 5.0], [0, 0, 1]], dtype=torch.float64).expand(2, 3, 3)

    def image(*inputs: Any) -> tuple[Tensor, Tensor, Tensor]:
        arguments: Any = (*inputs, intrinsics, width, height)
        raster = rasterize(*arguments, backend="reference")
        return raster.features, raster.depth, raster.alpha

    inputs = tuple(value.requires_grad_() for value in (*parameters, camera))
    torch.autograd.gradcheck(image, inputs, eps=1e-7, atol=1e-4, rtol=1e-4, fast_mode=True)


def test_shared_gaussians_equal_the_same_set_given_per_view():
    means, opacities, features = torch.tensor([[0.1, 0, 2.0]]), torch.tensor([0.5]), torch.tensor([[1.0]])
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.2)
    cameras = torch.eye(4).expand(3, 4, 4)
    intrinsics = torch.tensor([[FOCAL, 0, 4.5], [0, FOCAL, 4.5], [0, 0, 1]]).expand(3, 3, 3)
    shared = rasterize(means, quats, scales, opacities, features, cameras, intrinsics, 9, 9, backend="reference")
    per_view = rasterize(
        means.expand(3, 1, 3), quats, scales, opacities.expand(3, 1), features, cameras, intrinsics, 9, 9,
        backend="reference",
    )  # fmt: skip
    torch.testing.assert_close(shared.features, per_view.features)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": [[0.0, 0, 2], [0, math.nan, 2]]}, r"means at index \[1, 1\] is nan"),
        ({"opacities": [0.5, 1.5]}, r"opacities at index \[1\] is 1.5; expected 0..1"),
        ({"scales": [[0.1, 0.1, 0.1], [0.1, 0.1, -1]]}, r"scales at index \[1, 2\] is -1"),
        ({"quats": [[1.0, 0, 0, 0], [0, 0, 0, 0]]}, r"length of quats at index \[1\] is 0"),
        ({"features": [[1.0], [math.inf]]}, r"features at index \[1, 0\] is inf"),
    ],
)
def test_bad_values_are_named_with_their_first_index(change, message):
    arguments = {"means": [[0.0, 0, 2], [0, 0, 3]], "opacities": [0.5, 0.5], "features": [[1.0], [1.0]]}
    with pytest.raises(RenderError, match=message):
        render(**{**arguments, **change})
