"""A scene of a static and a moving set of Gaussians, and what it holds at a time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.serialise import named_tensors
from lerobot_msdyn.motion.model.compose import Level, compose, compose_points
from lerobot_msdyn.motion.model.composed import MOST_BYTES, ComposedLevel, composed_level
from lerobot_msdyn.render import Painted
from lerobot_msdyn.scene.gaussians import Gaussians
from lerobot_msdyn.scene.overlay import PATCH_OPACITY, FramePatch, Overlay
from lerobot_msdyn.scene.seen import shaded_moving
from lerobot_msdyn.scene.shading import Shading
from lerobot_msdyn.scene.short_lived import STILL, ShortLived
from lerobot_msdyn.scene.still_view import StillView, still_view


@dataclass(frozen=True)
class Snapshot:
    """All Gaussians of a scene at some frames, ready to be rasterized: the static ones first, or as a backdrop."""

    means: Float[Tensor, "b g 3"]
    quats: Float[Tensor, "b g 4"]
    scales: Float[Tensor, "*#b g 3"]
    opacities: Float[Tensor, "*#b g"]
    rgb: Float[Tensor, "b g 3"]
    moving: Float[Tensor, " g"]  # 1 for the moving set, 0 for the static one
    extra: Float[Tensor, " g"] | None = None  # another value of each
    backdrop: Painted | None = None  # the static set with its colours, if it is not among the others


def patched(snapshot: Snapshot, patch: FramePatch) -> Snapshot:
    """A snapshot of one frame, with a patch in place of what the patch hides; the patch counts as moving."""
    ones = patch.means.new_ones(len(patch))
    backdrop, hidden = snapshot.backdrop, patch.hidden
    if backdrop is not None:
        behind = len(backdrop.backdrop)
        backdrop, hidden = replace(backdrop, hidden=backdrop.hidden | hidden[:behind]), hidden[behind:]
    left = torch.where(hidden, 0.0, snapshot.opacities)  # less to copy than without what is hidden
    return Snapshot(
        means=torch.cat((snapshot.means, patch.means[None]), dim=1),
        quats=torch.cat((snapshot.quats, patch.quats[None]), dim=1),
        scales=torch.cat((snapshot.scales, patch.log_scales.exp())),
        opacities=torch.cat((left, PATCH_OPACITY * ones)),
        rgb=torch.cat((snapshot.rgb, patch.rgb[None]), dim=1),
        moving=torch.cat((snapshot.moving, ones)),
        extra=None if snapshot.extra is None else torch.cat((snapshot.extra, ones)),
        backdrop=backdrop,
    )


def patched_together(snapshot: Snapshot, patches: Sequence[FramePatch]) -> Snapshot:
    """A snapshot of some frames, each with its patch as in `patched`; shorter ones are filled up with what is not seen.

    For devices that many small calls keep waiting: it takes more memory than the frames one by one.
    """
    b, g = len(patches), snapshot.means.shape[1]
    means, quats, log_scales, rgb = (
        pad_sequence([getattr(patch, name) for patch in patches], batch_first=True)
        for name in ("means", "quats", "log_scales", "rgb")
    )
    lengths = torch.tensor([len(patch) for patch in patches], device=means.device)[:, None]
    shown = torch.arange(means.shape[1], device=means.device) < lengths
    left = torch.where(torch.stack([patch.hidden for patch in patches]), 0.0, snapshot.opacities)
    ones = means.new_ones(means.shape[1])
    return Snapshot(
        means=torch.cat((snapshot.means, means), dim=1),
        quats=torch.cat((snapshot.quats, torch.where(shown[..., None], quats, 1.0)), dim=1),
        scales=torch.cat((snapshot.scales.expand(b, g, 3), log_scales.exp()), dim=1),
        opacities=torch.cat((left, PATCH_OPACITY * shown), dim=1),
        rgb=torch.cat((snapshot.rgb, rgb), dim=1),
        moving=torch.cat((snapshot.moving, ones)),
        extra=None if snapshot.extra is None else torch.cat((snapshot.extra, ones)),
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
    short_lived: ShortLived | None = None  # none: nothing lives for a few frames alone
    overlay: Overlay | None = None  # none: nothing is shown as it was recorded
    canonical_frame: int = 0  # at which all bases are the identity; of use to the fit alone, files do not keep it

    @property
    def device(self) -> torch.device:
        """Where its tensors are."""
        return self.static.means.device

    def select_static(self, which: Tensor | slice) -> "DynamicScene":
        """The same with some Gaussians of the static set, by index, mask or slice; of a scene without patches."""
        shading = None if self.shading is None else replace(self.shading, places=self.shading.places[which])
        return replace(self, static=self.static.select(which), shading=shading)

    def select_moving(self, which: Tensor | slice) -> "DynamicScene":
        """The same with some Gaussians of the moving set, by index, mask or slice; of a scene without patches."""
        shading = None if self.shading is None else replace(self.shading, moving=self.shading.moving[:, which])
        indices, logits = self.followed_by(which)
        return replace(self, moving=self.moving.select(which), indices=indices, logits=logits, shading=shading)

    def composed(self, most_bytes: int = MOST_BYTES) -> "DynamicScene":
        """The same, on the CPU with its levels as one, which remembers frames; where they are learned, as it is."""
        level = composed_level(self.levels, self.indices, self.logits, most_bytes)
        if level is None:
            return self
        numbers = torch.arange(len(self.moving))[:, None]
        return replace(self, levels=(level,), indices=(numbers,), logits=(torch.zeros(len(numbers), 1),))

    def decomposed(self) -> "DynamicScene":
        """The same with its levels one by one."""
        if len(self.levels) != 1 or not isinstance(self.levels[0], ComposedLevel):
            return self
        level, rows = self.levels[0], self.indices[0][:, 0]
        indices, logits = (tuple(each[rows] for each in kind) for kind in (level.indices, level.logits))
        return replace(self, levels=level.levels, indices=indices, logits=logits)

    def still(self) -> "DynamicScene":
        """The same without what moves and without patches: the static set, its brightness and the near plane."""
        return replace(self.select_moving(slice(0)).without_patches(), levels=(), indices=(), logits=())

    def still_view(self, camera: CameraTrack, backend: str = "auto", *, once: bool = False) -> StillView:
        """The static set before the first pose of a camera (on its device), for `once` or for many pictures."""
        return still_view(self.static, self.shading, camera, self.near, backend, once=once)

    def still_before(self, camera: CameraTrack, backend: str = "auto") -> StillView | None:
        """The same for all pictures of a camera; None where it moves, or on a GPU, for which projecting is little."""
        if self.device.type != "cpu" or not camera.is_static:
            return None
        return self.still_view(camera, backend)

    def without_patches(self) -> "DynamicScene":
        """What its two sets alone show."""
        return replace(self, short_lived=None, overlay=None)

    def patch(self, frame: int) -> FramePatch | None:
        """What a frame shows beside the two sets: short-lived Gaussians, an overlay; None if there is neither."""
        short = self.short_lived_patch(frame)
        if self.overlay is None:
            return short
        own = len(self.static) + len(self.moving)
        if short is None:
            return self.overlay.patch(frame, own)
        single = self.overlay.patch(frame, own + len(short))
        kept = (~single.hidden[own:]).nonzero()[:, 0]
        return FramePatch(
            torch.cat((short.means[kept], single.means)),
            torch.cat((short.quats[kept], single.quats)),
            torch.cat((short.log_scales[kept], single.log_scales)),
            torch.cat((short.rgb[kept], single.rgb)),
            short.hidden | single.hidden[:own],
            len(kept),
        )

    def short_lived_patch(self, frame: int) -> FramePatch | None:
        """The short-lived Gaussians that a frame shows, where they are then; None where the scene has none."""
        short = self.short_lived
        if short is None:
            return None
        rows = short.rows(frame)
        carrier, means, quats = short.carrier[rows].long(), short.means[rows], short.quats[rows].float()
        if len(self.moving) > 0:
            when = torch.tensor([frame], device=self.device)
            indices, logits = self.followed_by(carrier.clamp(min=0))
            moved, turned = compose(means, quats, self.levels, indices, logits, when)
            still = (carrier == STILL)[:, None]
            means, quats = torch.where(still, means, moved[0]), torch.where(still, quats, turned[0])
        own = len(self.static) + len(self.moving)
        log_scales, rgb = short.log_scales[rows].float(), short.rgb[rows].float()
        return FramePatch(means, quats, log_scales, rgb, short.hidden_at(frame, own), len(rows))

    def followed_by(self, which: Tensor | slice) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Indices and logits per level of some of the moving set."""
        return tuple(rows[which] for rows in self.indices), tuple(rows[which] for rows in self.logits)

    def at(
        self,
        frames: Int[Tensor, " b"],
        eye: Float[Tensor, "b 3"] | None = None,
        backdrop: Painted | None = None,
    ) -> Snapshot:
        """The scene at some frames, differentiable in all Gaussians and bases.

        Args:
            frames: the frames.
            eye: from where it is seen at each (m), for colours that depend on it; without, their means are given.
            backdrop: what its static set shows there, which is left out then.
        """
        frames = frames.to(self.device)
        if backdrop is not None:
            with torch.no_grad():  # else the static set has gradients of zero
                others = self.select_static(slice(0))
            return replace(others.at(frames, eye), backdrop=backdrop)
        static, moving = self.static, self.moving
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
        sets = {name: getattr(self, name) for name in ("static", "moving", "shading", "short_lived", "overlay")}
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
        if self.shading is not None and len(self.static) > 0:
            static = static * self.shading.static_gain(frames)[..., None]
        if self.shading is not None:
            moving = moving * self.shading.moving_gain(frames)[..., None]
        return torch.cat((static, moving), dim=1)
