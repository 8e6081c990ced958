"""The optimisation: Gaussians are moved, sized and coloured until the recorded camera sees the recorded pictures."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.config import FitConfig, LearningRates
from lerobot_msdyn.episode import View
from lerobot_msdyn.losses import certain_pixels, depth_loss, mask_loss, rgb_loss
from lerobot_msdyn.priors import Priors
from lerobot_msdyn.rendering import Rendering, draw
from lerobot_msdyn.scene import DynamicScene, Gaussians

logger = logging.getLogger(__name__)

MASK_BAND_PX = 2  # the mask is not trusted closer than this to its border
FINAL_RATE = 0.1  # the learning rates decay exponentially to this share


@dataclass(frozen=True)
class FitResult:
    """A fitted scene and how the fit went."""

    scene: DynamicScene
    losses: dict[str, float]  # mean of each unweighted term over the last tenth of the steps
    train_psnr_db: float  # over a few frames of the recorded camera
    seconds: float


@dataclass(frozen=True)
class _Targets:
    """What one frame should look like."""

    rgb: Float[Tensor, "b h w 3"]
    depth: Float[Tensor, "b h w"]
    moving: Bool[Tensor, "b h w"]
    certain: Bool[Tensor, "b h w"]


def fit(
    scene: DynamicScene,
    view: View,
    priors: Priors,
    config: FitConfig,
    *,
    distance: float,
    seed: int,
    backend: str = "auto",
    progress: Callable[[int], object] = lambda steps: None,
) -> FitResult:
    """Fit a scene to one camera's video; motion stays as it was initialised.

    Args:
        scene: where to start from; it is not changed.
        view: the video, at the size at which it is fitted.
        priors: its priors, at the same size.
        config: steps, weights and learning rates.
        distance: distance to the look-at point (m), the unit of the means' learning rate.
        seed: fixes the order of the frames.
        backend: of the rasterizer.
        progress: called with the number of steps done since the last call.
    """
    start = time.perf_counter()
    scene, optimizer = _trainable(scene, config.learning_rates, distance)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, FINAL_RATE ** (1 / max(config.steps, 1)))
    generator = torch.Generator().manual_seed(seed)
    order = torch.empty(0, dtype=torch.long)
    history: list[dict[str, Tensor]] = []
    for _ in range(config.steps):
        if len(order) == 0:
            order = torch.randperm(len(view.rgb), generator=generator)
        frames, order = order[:1], order[1:]
        terms = loss_terms(draw(scene, view.camera.select(frames), frames, backend), _targets(view, priors, frames))
        loss = torch.stack([getattr(config.weights, name) * term for name, term in terms.items()]).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        decay.step()
        history.append({name: term.detach() for name, term in terms.items()})
        progress(1)
    scene = _detached(scene)
    last = history[-max(1, len(history) // 10) :]
    losses = {name: float(torch.stack([step[name] for step in last]).mean()) for name in (last[0] if last else {})}
    result = FitResult(scene, losses, train_psnr(scene, view, backend), time.perf_counter() - start)
    logger.info(
        "fit: %d + %d Gaussians, %d steps in %.0f s, %.1f dB on the recorded camera",
        len(scene.static),
        len(scene.moving),
        config.steps,
        result.seconds,
        result.train_psnr_db,
    )
    return result


def loss_terms(drawn: Rendering, targets: _Targets) -> dict[str, Float[Tensor, ""]]:
    """All loss terms, unweighted, by the names of their weights."""
    return {
        "rgb": rgb_loss(drawn.rgb, targets.rgb),
        "depth": depth_loss(drawn.depth, targets.depth, drawn.alpha),
        "mask": mask_loss(drawn.moving, targets.moving, targets.certain),
    }


@torch.no_grad()
def train_psnr(scene: DynamicScene, view: View, backend: str = "auto", count: int = 5) -> float:
    """Peak signal-to-noise ratio (dB) of the drawn against the recorded pictures, over `count` evenly spread frames."""
    frames = torch.linspace(0, len(view.rgb) - 1, min(count, len(view.rgb))).round().long()
    drawn = draw(scene, view.camera.select(frames), frames, backend).rgb.clamp(0, 1)
    error = (drawn - view.rgb[frames].float() / 255).square().mean()
    return float(-10 * torch.log10(error.clamp(min=1e-10)))


def _targets(view: View, priors: Priors, frames: Tensor) -> _Targets:
    moving = priors.instances[frames] > 0
    return _Targets(view.rgb[frames].float() / 255, priors.depth[frames], moving, certain_pixels(moving, MASK_BAND_PX))


def _trainable(
    scene: DynamicScene, rates: LearningRates, distance: float
) -> tuple[DynamicScene, torch.optim.Optimizer]:
    """The scene with its Gaussians as leaves, and Adam over them."""
    rate = {
        "means": rates.means * distance,
        "quats": rates.quats,
        "log_scales": rates.log_scales,
        "opacity_logits": rates.opacity_logits,
        "sh": rates.colours,
    }
    static, moving = (
        Gaussians(**{item.name: getattr(part, item.name).clone().requires_grad_() for item in fields(part)})
        for part in (scene.static, scene.moving)
    )
    groups = [{"params": [getattr(part, name)], "lr": lr} for part in (static, moving) for name, lr in rate.items()]
    return replace(scene, static=static, moving=moving), torch.optim.Adam(groups, eps=1e-15)


def _detached(scene: DynamicScene) -> DynamicScene:
    def plain(part: Gaussians) -> Gaussians:
        return Gaussians(**{item.name: getattr(part, item.name).detach() for item in fields(part)})

    return replace(scene, static=plain(scene.static), moving=plain(scene.moving))
