"""Gaussians that keep still before a camera that does: projected once, shown in many pictures with other colours."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.core.errors import RenderError


@dataclass(frozen=True)
class Splats:
    """What the CPU backend renders of a backdrop, from near to far."""

    sources: np.ndarray  # int32 [v], Gaussians of the backdrop
    heads: np.ndarray  # float32 [v, HEAD], of their records
    depths: np.ndarray  # float32 [v], z-depth, m


@dataclass(frozen=True)
class Backdrop:
    """Gaussians, and the pose and the picture in which they are seen; made by `project_backdrop`."""

    means: Float[Tensor, "s 3"]  # m
    quats: Float[Tensor, "s 4"]
    scales: Float[Tensor, "s 3"]  # m
    opacities: Float[Tensor, " s"]
    camera_from_world: Float[Tensor, "4 4"]
    intrinsics: Float[Tensor, "3 3"]  # px
    width: int  # px
    height: int  # px
    near: float  # m
    splats: Splats | None  # None: it is projected in every picture

    def __len__(self) -> int:
        return self.means.shape[0]


@dataclass(frozen=True)
class Painted:
    """A backdrop with the colours that it has in some pictures through its own camera; without gradients.

    Features are the same in all pictures, gains and what is hidden may be of each.
    """

    backdrop: Backdrop
    plain: Float[Tensor, "s c"]  # features before gains
    gains: Float[Tensor, "*#views s"]
    hidden: Bool[Tensor, "*#views s"]  # those that are not rendered

    @property
    def features(self) -> Float[Tensor, "*views s c"]:
        """What is blended."""
        return self.plain * self.gains[..., None]

    @property
    def opacities(self) -> Float[Tensor, "*#views s"]:
        """0..1; 0 for those that are not rendered."""
        return torch.where(self.hidden, 0.0, self.backdrop.opacities)

    def check_shapes(self, views: int, channels: int) -> None:
        """Whether it can be rendered in so many views, with others that have so many features.

        Raises:
            RenderError: a shape does not fit.
        """
        count = len(self.backdrop)
        if self.plain.shape != (count, channels):
            raise RenderError(
                f"features of the backdrop have shape {list(self.plain.shape)}; expected {[count, channels]}"
            )
        for name in ("gains", "hidden"):
            got = tuple(getattr(self, name).shape)
            if got not in ((count,), (views, count)):
                raise RenderError(
                    f"{name} of the backdrop have shape {list(got)}; expected {[count]}, or {[views, count]} (one set "
                    "per view)"
                )

    def check_cameras(
        self,
        camera_from_world: Float[Tensor, "b 4 4"],
        intrinsics: Float[Tensor, "b 3 3"],
        width: int,
        height: int,
        near: float,
    ) -> None:
        """Whether it was projected for these views.

        Raises:
            RenderError: it was for another camera, size or near plane, or poses are learned.
        """
        own = self.backdrop
        same = (width, height, near) == (own.width, own.height, own.near)
        same &= bool((camera_from_world == own.camera_from_world).all() and (intrinsics == own.intrinsics).all())
        if not same or camera_from_world.requires_grad:
            raise RenderError(
                "the backdrop was projected for another pose, intrinsics, size or near plane, or the pose is learned; "
                "expected views like the one for which it was projected: project it anew, or give its Gaussians with "
                "the others"
            )
