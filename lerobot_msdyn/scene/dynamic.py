"""A scene of a static and a moving set of Gaussians, and what it holds at a time."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.serialise import named_tensors
from lerobot_msdyn.motion.model.compose import Level, compose, compose_points
from lerobot_msdyn.scene.gaussians import Gaussians
from lerobot_msdyn.scene.overlay import PATCH_OPACITY, FramePatch, Overlay
from lerobot_msdyn.scene.seen import shaded_moving
from lerobot_msdyn.scene.shading import Shading


@dataclass(frozen=True)
class Snapshot:
    """All Gaussians of a scene at some frames, ready to be rasterized: the static ones first."""

    means: Float[Tensor, "b g 3"]
    quats: Float[Tensor, "b g 4"]
    scales: Float[Tensor, "g 3"]
    opacities: Float[Tensor, " g"]
    rgb: Float[Tensor, "b g 3"]
    moving: Float[Tensor, " g"]  # 1 for the moving set, 0 for the static one
    extra: Float[Tensor, " g"] | None = None  # another value of each


def patched(snapshot: Snapshot, patch: FramePatch) -> Snapshot:
    """A snapshot of one frame, with a patch in place of what the patch hides; the patch counts as moving."""
    kept, ones = (~patch.hidden).nonzero()[:, 0], patch.means.new_ones(len(patch))
    return Snapshot(
        means=torch.cat((snapshot.means[:, kept], patch.means[None]), dim=1),
        quats=torch.cat((snapshot.quats[:, kept], patch.quats[None]), dim=1),
        scales=torch.cat((snapshot.scales[kept], patch.log_scales.exp())),
        opacities=torch.cat((snapshot.opacities[kept], PATCH_OPACITY * ones)),
        rgb=torch.cat((snapshot.rgb[:, kept], patch.rgb[None]), dim=1),
        moving=torch.cat((snapshot.moving[kept], ones)),
        extra=None if snapshot.extra is None else torch.cat((snapshot.extra[kept], ones)),
    )


@dataclass(frozen=True)
class DynamicScene:
    """A static set, a moving set in its canonical frame, and the levels of motion that carry it (docs/motion.md)."""

    static: Gaussians
    moving: Gaussians
    levels: tuple[Level, ...]  # coarse to fine
    indices: tuple[Int[Tensor, "n _"], ...]  # per level: the bases that move each Gaussian
    logits: tuple[Float[Tensor, "n _"], ...]  # per level: their weights before the softmax
    frames: int
    shading: Shading | None = None  # none: brightness does not change
    near: float = 0.01  # m; nothing that is as near to a camera is rendered
    overlay: Overlay | None = None  # none: nothing is shown as it was recorded
    canonical_frame: int = 0  # at which all bases are the identity; of use to the fit alone, files do not keep it

    @property
    def device(self) -> torch.device:
        """Where its tensors are."""
        return self.static.means.device

    def select_static(self, which: Tensor | slice) -> "DynamicScene":
        """The same with some Gaussians of the static set, by index, mask or slice; of a scene without an overlay."""
        shading = None if self.shading is None else replace(self.shading, places=self.shading.places[which])
        return replace(self, static=self.static.select(which), shading=shading)

    def select_moving(self, which: Tensor | slice) -> "DynamicScene":
        """The same with some Gaussians of the moving set, by index, mask or slice; of a scene without an overlay."""
        shading = None if self.shading is None else replace(self.shading, moving=self.shading.moving[:, which])
        indices, logits = (tuple(rows[which] for rows in levels) for levels in (self.indices, self.logits))
        return replace(self, moving=self.moving.select(which), indices=indices, logits=logits, shading=shading)

    def still(self) -> "DynamicScene":
        """The same without what moves and without an overlay: the static set, its brightness and the near plane."""
        return replace(self.select_moving(slice(0)), levels=(), indices=(), logits=(), overlay=None)

    def at(self, frames: Int[Tensor, " b"], eye: Float[Tensor, "b 3"] | None = None) -> Snapshot:
        """The scene at some frames, differentiable in all Gaussians and bases.

        Args:
            frames: the frames.
            eye: from where it is seen at each (m), for colours that depend on it; without, their means are given.
        """
        static, moving, frames = self.static, self.moving, frames.to(self.device)
        means, quats = compose(moving.means, moving.quats, self.levels, self.indices, self.logits, frames)
        b = len(frames)
        return Snapshot(
            means=torch.cat((static.means.expand(b, -1, -1), means), dim=1),
            quats=torch.cat((static.quats.expand(b, -1, -1), quats), dim=1),
            scales=torch.cat((static.scales, moving.scales)),
            opacities=torch.cat((static.opacity_logits, moving.opacity_logits)).sigmoid(),
            rgb=self._colours(frames, means, quats, eye),
            moving=torch.cat((torch.zeros_like(static.opacity_logits), torch.ones_like(moving.opacity_logits))),
        )

    def positions(self, frames: Int[Tensor, " b"]) -> Float[Tensor, "b g 3"]:
        """Where all Gaussians (m; the static ones first) are at some frames, as `at` has them."""
        moving = compose_points(self.moving.means, self.levels, self.indices, self.logits, frames.to(self.device))
        return torch.cat((self.static.means.expand(len(frames), -1, -1), moving), dim=1)

    def tensors(self) -> dict[str, Tensor]:
        """All that the scene is made of, by the names of its file."""
        sets = {"static": self.static, "moving": self.moving, "shading": self.shading, "overlay": self.overlay}
        bindings = [{"indices": index, "logits": row} for index, row in zip(self.indices, self.logits, strict=True)]
        return named_tensors(sets) | named_tensors(self.levels, "levels") | named_tensors(bindings, "levels")

    def _colours(
        self,
        frames: Int[Tensor, " b"],
        means: Float[Tensor, "b m 3"],
        quats: Float[Tensor, "b m 4"],
        eye: Float[Tensor, "b 3"] | None,
    ) -> Float[Tensor, "b g 3"]:
        """Colours at some frames, given where the moving set is there and how it is turned."""
        static = self.static.rgb.expand(len(frames), -1, -1)
        moving = self.moving.rgb.expand(len(frames), -1, -1)
        if eye is not None and self.moving.sh.shape[1] > 1:
            moving = shaded_moving(self.moving.sh, self.moving.quats, quats, means, eye)
        if self.shading is not None:
            static = static * self.shading.static_gain(frames)[..., None]
            moving = moving * self.shading.moving_gain(frames)[..., None]
        return torch.cat((static, moving), dim=1)
