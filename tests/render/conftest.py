"""Random scenes for the tests of the rasterizers."""

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from lerobot_msdyn.render import Raster, rasterize


@dataclass
class Scene:
    """What `rasterize` takes: Gaussians in front of a few cameras that look along +z from near the origin."""

    gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor]  # means, quats, scales, opacities, features
    poses: Tensor
    intrinsics: Tensor
    width: int
    height: int

    def render(
        self, backend: str, dtype: torch.dtype = torch.float32, device: str = "cpu"
    ) -> tuple[Raster, list[Tensor]]:
        """The images, and the leaves (Gaussians, then poses) that their gradients go to."""
        tensors = [values.to(device, dtype) for values in (*self.gaussians, self.poses)]
        leaves = [values.detach().clone().requires_grad_() for values in tensors]
        means, quats, scales, opacities, features, poses = leaves
        intrinsics = self.intrinsics.to(device, dtype)
        size = (self.width, self.height)
        return rasterize(means, quats, scales, opacities, features, poses, intrinsics, *size, backend=backend), leaves


def random_scene(
    count: int = 300,
    width: int = 77,
    height: int = 45,
    channels: int = 3,
    views: int = 1,
    seed: int = 0,
    radius: float = 3.0,
    opacity: tuple[float, float] = (0.05, 0.95),
    per_view: tuple[int, ...] = (),
) -> Scene:
    """Gaussians of about `radius` px; `per_view` lists the Gaussian tensors that get one set per view."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    focal = 0.9 * width
    depth = 1 + 2 * uniform(count)
    across = (uniform(count, 2) - 0.5) * 1.3 * torch.tensor([width, height]) / focal
    means = torch.cat((across, torch.ones(count, 1)), 1) * depth[:, None]
    scales = radius / focal * depth[:, None] * torch.exp(0.5 * torch.randn(count, 3, generator=generator))
    quats = torch.randn(count, 4, generator=generator) * 2
    opacities = opacity[0] + (opacity[1] - opacity[0]) * uniform(count)
    shared = (means, quats, scales, opacities, uniform(count, channels))
    varied = {i: shared[i] * (1 + 0.05 * uniform(views, *shared[i].shape) - 0.05) for i in per_view}
    means, quats, scales, opacities, features = (varied.get(i, values) for i, values in enumerate(shared))
    poses = torch.eye(4).repeat(views, 1, 1)
    angles = 0.1 * (uniform(views) - 0.5)
    poses[:, 0, 0] = poses[:, 2, 2] = angles.cos()
    poses[:, 0, 2], poses[:, 2, 0] = angles.sin(), -angles.sin()
    poses[:, :3, 3] = 0.1 * (uniform(views, 3) - 0.5)
    intrinsics = torch.tensor([[focal, 0, width / 2 + 0.3], [0, 1.1 * focal, height / 2 - 0.2], [0, 0, 1]])
    return Scene((means, quats, scales, opacities, features), poses, intrinsics.repeat(views, 1, 1), width, height)


@pytest.fixture
def make_scene():
    """`random_scene`, as a fixture."""
    return random_scene


def relative_error(got: Tensor | None, expected: Tensor | None) -> float:
    """|got - expected| / |expected|, over all entries; both must be there."""
    assert got is not None
    assert expected is not None
    got = got.to(expected.device)
    return (torch.linalg.norm((got - expected).double()) / torch.linalg.norm(expected.double())).item()


@dataclass
class Comparison:
    """How far a backend is from the float64 reference."""

    off: float  # fraction of pixels of which some value is off by more than 1e-4
    worst: float  # largest difference at the other pixels
    gradients: list[float]  # relative error of each leaf's gradient, thresholds' pixels left out


def compare(
    scene: Scene, backend: str = "cpu", seed: int = 1, device: str = "cpu", close_enough: float = 2e-5
) -> Comparison:
    """Compare a backend in float32 with the reference in float64.

    Where rounding decides whether an alpha counts as below 1/255, or a pixel as opaque, the two differ by a finite
    step. Such pixels are counted, and receive no gradient.
    """
    fast, fast_leaves = scene.render(backend, device=device)
    fast = Raster(fast.features.cpu(), fast.depth.cpu(), fast.alpha.cpu())
    exact, exact_leaves = scene.render("reference", torch.float64)
    errors = [
        (fast.features - exact.features).abs().amax(-1),
        (fast.depth - exact.depth).abs(),
        (fast.alpha - exact.alpha).abs(),
    ]
    error = torch.stack(errors).amax(0)
    close = error < close_enough
    generator = torch.Generator().manual_seed(seed)
    names = ("features", "depth", "alpha")
    incoming = [torch.randn(getattr(fast, name).shape, generator=generator) for name in names]
    incoming = [values * (close[..., None] if values.ndim == 4 else close) for values in incoming]
    torch.autograd.backward([getattr(fast, name) for name in names], incoming)
    torch.autograd.backward([getattr(exact, name) for name in names], [values.double() for values in incoming])
    gradients = [
        relative_error(a.grad, b.grad) for a, b in zip(fast_leaves, exact_leaves, strict=True) if b.numel() > 0
    ]
    assert all(math.isfinite(value) for value in gradients)
    return Comparison((error > 1e-4).double().mean().item(), error[error <= 1e-4].max().item(), gradients)


@pytest.fixture
def compare_with_reference():
    """`compare`, as a fixture."""
    return compare
