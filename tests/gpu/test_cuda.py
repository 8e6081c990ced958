"""The CUDA backend draws the reference's picture; skipped where there is no CUDA device or no gsplat."""

import pytest
import torch

from lerobot_msdyn.render import rasterize

pytestmark = pytest.mark.gpu


@pytest.fixture
def device() -> torch.device:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    pytest.importorskip("gsplat")
    return torch.device("cuda")


@pytest.mark.parametrize("per_view", [False, True])
def test_values_and_gradients_are_those_of_the_reference(device: torch.device, per_view: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    count, views, width, height = 300, 2, 48, 36
    shape = (views, count) if per_view else (count,)
    means = torch.randn(*shape, 3, generator=generator) * 0.3 + torch.tensor([0.0, 0.0, 2.0])
    scales = 0.02 + 0.05 * torch.rand(*shape, 3, generator=generator)
    inputs = (
        means,
        torch.randn(*shape, 4, generator=generator),
        scales,
        0.1 + 0.8 * torch.rand(*shape, generator=generator),
        torch.rand(*shape, 4, generator=generator),
    )
    pose = torch.eye(4).repeat(views, 1, 1)
    pose[1, 0, 3] = 0.1
    intrinsics = torch.tensor([[45.0, 0, 24], [0, 45, 18], [0, 0, 1]]).expand(views, 3, 3)
    results = []
    for where, backend in ((torch.device("cpu"), "reference"), (device, "cuda")):
        leaves = [values.to(where, copy=True).requires_grad_() for values in inputs]
        raster = rasterize(*leaves, pose.to(where), intrinsics.to(where), width, height, backend=backend)
        loss = raster.features.square().sum() + raster.depth.sum() + raster.alpha.sum()
        gradients = torch.autograd.grad(loss, leaves)
        results.append([raster.features, raster.depth, raster.alpha, *gradients])
    for expected, found in zip(*results, strict=True):
        error = (expected - found.cpu()).norm() / expected.norm()
        assert float(error.detach()) < 1e-2
