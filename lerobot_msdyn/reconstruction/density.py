"""Adaptive density control: Gaussians where the pictures ask for more, none where they do nothing.

3D Gaussian Splatting (Kerbl et al. 2023), section 5.2, for the static set and, in the canonical frame, the moving one.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import DensityConfig
from lerobot_msdyn.core.geometry import quaternion_to_matrix, transform_points
from lerobot_msdyn.reconstruction.parameters import SETS, Parameters, Resampled
from lerobot_msdyn.scene.dynamic import Snapshot
from lerobot_msdyn.scene.gaussians import Gaussians, concatenate

SPLIT_INTO = 2  # Gaussians that take the place of one ...
SHRINK = 1.6  # ... each smaller by this
RESET_OPACITY = 2.0  # times the opacity below which Gaussians are pruned: opacities are reset to at most this


class Density:
    """Gradients of the Gaussians' places in the image, gathered from step to step, and what follows from them."""

    def __init__(self, config: DensityConfig, parameters: Parameters, steps: int, distance: float, seed: int) -> None:
        """For a fit of so many steps.

        Args:
            config: when, and by what thresholds.
            parameters: what is controlled.
            steps: of the whole fit.
            distance: to the look-at point (m), the unit of the sizes.
            seed: of the places of split Gaussians.
        """
        self.config, self.parameters, self.distance = config, parameters, distance
        self._first, self._last = round(config.begin * steps), round(config.end * steps)
        self._generator = torch.Generator().manual_seed(seed)
        scene = parameters.scene
        self._most = {part: int(config.growth * len(getattr(scene, part))) for part in SETS}
        self._forget()

    def watch(self, snapshot: Snapshot) -> None:
        """Have a snapshot's means keep their gradient; called before the loss goes backwards."""
        if self.config.enabled and snapshot.means.requires_grad:
            snapshot.means.retain_grad()

    def after(self, step: int, snapshot: Snapshot, camera: CameraTrack) -> None:
        """Take note of a snapshot's gradients, and control both sets where a round is due after so many steps."""
        config = self.config
        if not config.enabled or snapshot.means.grad is None:
            return
        moved = image_gradients(snapshot.means.detach(), snapshot.means.grad, camera)
        self._total += moved.sum(0).cpu()
        self._count += (moved > 0).sum(0).cpu()
        if config.reset_every > 0 and step % config.reset_every == 0 and step < self._last:
            self._reset_opacities()
        if step % config.every == 0 and self._first < step <= self._last:
            self._control()

    @torch.no_grad()
    def _control(self) -> None:
        scene = self.parameters.scene
        mean = self._total / self._count.clamp(min=1)
        gradients = dict(zip(SETS, mean.split([len(scene.static), len(scene.moving)]), strict=True))
        for part in SETS:
            new = controlled(
                getattr(scene, part),
                gradients[part].to(scene.device),
                self.config,
                self.distance,
                self._most[part],
                self._generator,
            )
            self.parameters.resample(part, new)
        self._forget()

    @torch.no_grad()
    def _reset_opacities(self) -> None:
        """Opacities to a low value, from which those that are needed recover and the others are pruned."""
        for part in SETS:
            gaussians: Gaussians = getattr(self.parameters.scene, part)
            low = torch.logit(torch.tensor(min(RESET_OPACITY * self.config.min_opacity, 0.99)))
            self.parameters.reset(f"{part}.opacity_logits", gaussians.opacity_logits.clamp(max=float(low)))

    def _forget(self) -> None:
        scene = self.parameters.scene
        self._total, self._count = torch.zeros(2, len(scene.static) + len(scene.moving))


@torch.no_grad()
def image_gradients(
    means: Float[Tensor, "b g 3"], gradient: Float[Tensor, "b g 3"], camera: CameraTrack
) -> Float[Tensor, "b g"]:
    """Lengths of the loss's gradients by the Gaussians' places in the image, in halves of its width and height.

    From those by their means (m), of which the part across the line of sight shifts the place by f / z.
    """
    pose = camera.camera_from_world
    in_camera = (pose[:, None, :3, :3] @ gradient[..., None])[..., :2, 0]
    depth = transform_points(pose, means)[..., 2:].clamp(min=0)
    focal = camera.intrinsics[:, None, [0, 1], [0, 1]]
    halves = torch.tensor([camera.width / 2, camera.height / 2], device=means.device)
    return (in_camera * depth / focal * halves).norm(dim=-1)


def controlled(
    gaussians: Gaussians,
    gradient: Float[Tensor, " g"],
    config: DensityConfig,
    distance: float,
    most: int,
    generator: torch.Generator,
) -> Resampled:
    """A set after one round: cloned or split where the gradient is large, pruned where faint or huge.

    Args:
        gaussians: the set.
        gradient: mean gradient of each one's place in the image.
        config: thresholds.
        distance: m, the unit of the sizes.
        most: Gaussians beyond which the set does not grow; those of the largest gradients come first.
        generator: draws the places of split ones.
    """
    size = gaussians.scales.amax(-1)
    kept = (gaussians.opacity_logits.sigmoid() >= config.min_opacity) & (size <= config.max_size * distance)
    wanted = _largest(gradient, kept & (gradient > config.gradient), most - int(kept.sum()))
    large = size > config.clone_size * distance
    stay = (kept & ~(wanted & large)).nonzero()[:, 0]
    cloned = (wanted & ~large).nonzero()[:, 0]
    split = (wanted & large).nonzero()[:, 0].repeat(SPLIT_INTO)
    rows = torch.cat((stay, cloned, split))
    fresh = torch.ones_like(rows, dtype=torch.bool)
    fresh[: len(stay)] = False
    return Resampled(
        concatenate([gaussians.select(stay), gaussians.select(cloned), _drawn(gaussians.select(split), generator)]),
        rows,
        fresh,
    )


def _largest(gradient: Float[Tensor, " g"], among: Bool[Tensor, " g"], count: int) -> Bool[Tensor, " g"]:
    """The `count` of some Gaussians whose gradients are largest."""
    rows: Int[Tensor, " n"] = among.nonzero()[:, 0]
    chosen = torch.zeros_like(among)
    chosen[rows[gradient[rows].argsort(descending=True, stable=True)[: max(count, 0)]]] = True
    return chosen


def _drawn(gaussians: Gaussians, generator: torch.Generator) -> Gaussians:
    """Smaller Gaussians at places drawn from these."""
    local = torch.randn(len(gaussians), 3, generator=generator).to(gaussians.means) * gaussians.scales
    turned = quaternion_to_matrix(torch.nn.functional.normalize(gaussians.quats, dim=-1)) @ local[..., None]
    return Gaussians(
        gaussians.means + turned[..., 0],
        gaussians.quats,
        gaussians.log_scales - torch.log(torch.tensor(SHRINK)),
        gaussians.opacity_logits,
        gaussians.sh,
    )
