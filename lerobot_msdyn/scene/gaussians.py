"""Sets of anisotropic Gaussians, and their colours as spherical harmonics."""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

SH_C0 = 0.28209479177387814  # the constant spherical harmonic
SH_C1 = 0.4886025119029199  # of the three linear ones
_SMALLEST_M = 1e-9  # standard deviation: far below any surface's, also where depth is of a wrong scale


@dataclass(frozen=True)
class Gaussians:
    """A set of anisotropic Gaussians; colours as spherical harmonics (3DGS, Kerbl et al. 2023)."""

    means: Float[Tensor, "g 3"]  # m
    quats: Float[Tensor, "g 4"]  # wxyz, of any non-zero length
    log_scales: Float[Tensor, "g s"]  # log of standard deviations in m; s = 3, or 1 for isotropic Gaussians
    opacity_logits: Float[Tensor, " g"]
    sh: Float[Tensor, "g k 3"]

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def rgb(self) -> Float[Tensor, "g 3"]:
        """Colours 0..1 (degree 0)."""
        return (self.sh[:, 0] * SH_C0 + 0.5).clamp(min=0)

    @property
    def scales(self) -> Float[Tensor, "g 3"]:
        """Standard deviations along the three axes, m."""
        return self.log_scales.exp().expand(-1, 3)

    def select(self, which: Tensor | slice) -> "Gaussians":
        """Some of the Gaussians, by index, mask or slice."""
        return Gaussians(**{item.name: getattr(self, item.name)[which] for item in fields(self)})


def with_slope(gaussians: Gaussians) -> Gaussians:
    """The same set with spherical harmonics of degree 1, whose linear part is zero."""
    return replace(gaussians, sh=torch.nn.functional.pad(gaussians.sh[:, :1], (0, 0, 0, 3)))


def shaded(sh: Float[Tensor, "m 4 3"], direction: Float[Tensor, "b m 3"]) -> Float[Tensor, "b m 3"]:
    """Colours 0..1 of spherical harmonics of degree 1 seen along directions of length 1 (in the canonical frame)."""
    x, y, z = direction[..., None].unbind(-2)
    linear = -y * sh[:, 1] + z * sh[:, 2] - x * sh[:, 3]
    return (SH_C0 * sh[:, 0] + SH_C1 * linear + 0.5).clamp(min=0)


def concatenate(parts: list[Gaussians]) -> Gaussians:
    """One set of several."""
    return Gaussians(**{item.name: torch.cat([getattr(p, item.name) for p in parts]) for item in fields(Gaussians)})


def gaussians_from_points(
    means: Float[Tensor, "g 3"],
    quats: Float[Tensor, "g 4"],
    scales: Float[Tensor, "g 3"],
    rgb: Float[Tensor, "g 3"],
    opacity: float,
) -> Gaussians:
    """Gaussians of given linear scales (m), colours 0..1 and one common opacity."""
    logit = torch.logit(torch.tensor(opacity))
    return Gaussians(
        means=means.contiguous(),
        quats=quats.contiguous(),
        log_scales=scales.clamp(min=_SMALLEST_M).log(),
        opacity_logits=logit.expand(len(means)).clone(),
        sh=rgb_to_sh(rgb),
    )


def rgb_to_sh(rgb: Float[Tensor, "g 3"]) -> Float[Tensor, "g 1 3"]:
    """Colours 0..1 as spherical harmonics of degree 0."""
    return ((rgb - 0.5) / SH_C0)[:, None].contiguous()


def isotropic(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians as balls of the same cross-section: the geometric mean of the two larger axes."""
    two_larger = gaussians.log_scales.sort(dim=-1, descending=True).values[:, :2]
    return replace(gaussians, log_scales=two_larger.mean(-1, keepdim=True))
