"""The optimisation: Gaussians are moved, sized and coloured until the recorded camera sees the recorded pictures."""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import FitConfig
from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.registries import LOSSES
from lerobot_msdyn.core.sampling import evenly, scaled_window
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.priors import Priors
from lerobot_msdyn.reconstruction.brightness import moving_gain, static_shading
from lerobot_msdyn.reconstruction.density import Density
from lerobot_msdyn.reconstruction.doubt import doubts
from lerobot_msdyn.reconstruction.focus import Focus
from lerobot_msdyn.reconstruction.learned_poses import LearnedPoses
from lerobot_msdyn.reconstruction.loss_terms import FitStep, Targets, certain_pixels
from lerobot_msdyn.reconstruction.parameters import Parameters
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import with_slope
from lerobot_msdyn.scene.rendering import render_scene, render_snapshot
from lerobot_msdyn.scene.shading import Shading, no_shading

logger = logging.getLogger(__name__)

MASK_BAND_PX = 2  # of 320: the mask is not trusted closer than this to its border
CHECK_STEPS = 50  # from one look at the held-out frames to the next
GAIN_DB = 0.02  # less than this is no improvement
SCORED_FRAMES = 5  # of the recorded camera, whose error is reported


@dataclass(frozen=True)
class FitResult:
    """A fitted scene and how the fit went."""

    scene: DynamicScene
    losses: dict[str, float]  # mean of each unweighted term in use over the last tenth of the steps
    train_psnr_db: float  # over a few frames of the recorded camera
    steps: int  # how many were taken
    seconds: float
    held_out: Int[Tensor, " b"]  # frames that were not fitted
    camera: CameraTrack  # the recorded one, on the host; with learned poses where they were learned


def fit(
    scene: DynamicScene,
    view: View,
    priors: Priors,
    config: FitConfig,
    *,
    empty: UInt8[Tensor, "h w 3"],
    distance: float,
    seed: int,
    backend: str = "auto",
    progress: Callable[[int], object] = lambda steps: None,
    learned: Sequence[dict[str, Any]] = (),
) -> FitResult:
    """Fit a scene to one camera's video, on the device that holds the scene.

    Motion stays as it was initialised, unless `config.learn` says otherwise or its tensors are `learned`.

    Args:
        scene: where to start from; it is not changed.
        view: the video, at the size at which it is fitted; on the host.
        priors: its priors, at the same size; on the host.
        config: steps, weights of the loss terms in use, and learning rates.
        empty: what a fixed camera sees where nothing moves, by which brightness is measured.
        distance: distance to the look-at point (m), the unit of the means' learning rate.
        seed: fixes the order of the frames.
        backend: of the rasterizer.
        progress: called with the number of steps done since the last call.
        learned: further groups of parameters for Adam, such as leaves among the scene's levels; changed in place.

    Raises:
        ConfigError: a weight names a loss term that is not there.
        EpisodeError: the loss is no finite number any more.
    """
    start = time.perf_counter()
    if config.shadows:
        shading = static_shading(to_device(scene, "cpu"), view, priors, empty)
        scene = replace(scene, shading=to_device(shading, scene.device))
    if config.sh_degree > 0:
        scene = replace(scene, moving=with_slope(scene.moving))
    doubt = doubts(to_device(scene, "cpu"), view.camera, priors, config.learn.sure_px) if config.learn.bases else ()
    order, held_out = _frames(len(view.rgb), config.held_out_frames, seed)
    poses = None
    if config.learn.poses and not view.camera.is_static:
        poses = LearnedPoses(view.camera, held_out, config.learning_rates, distance, scene.device)
    parameters = Parameters(scene, config, distance, doubt, [*learned, *(poses.groups if poses else [])])
    density = Density(config.density, parameters, config.steps, distance, seed)
    wanted = Focus.wanted(config, view, priors) and not learned
    focus = Focus(to_device(scene, "cpu"), view, priors, scene.device) if wanted else None
    moves = priors.instances > 0
    certain = certain_pixels(moves, scaled_window(MASK_BAND_PX, view.camera.width))
    targets = to_device(Targets(view, priors, moves, certain, distance), scene.device)
    terms = {name: (LOSSES.get(name), weight) for name, weight in config.weights.items() if weight > 0}
    enough = _Enough(held_out, config.patience, backend)
    random = torch.Generator().manual_seed(seed)
    history: list[dict[str, Tensor]] = []
    for step in range(config.steps):
        if step == int(config.learn.begin * config.steps):
            parameters.begin_motion()
        scene = parameters.scene
        if step == int(config.moving_gain_from * config.steps) and len(scene.moving) > 0:
            filmed = view if poses is None else replace(view, camera=poses.result())
            parameters.shade(_measured_shading(scene, filmed, priors, backend))
            scene = parameters.scene
        drawn = next(order)
        frames = drawn.to(scene.device)
        through = targets.view.camera
        if poses is not None:  # pictures alone draw at them: tracks are of what moves
            through = poses.camera
            known = replace(through, world_from_camera=through.world_from_camera.detach())
            targets = replace(targets, view=replace(targets.view, camera=known))
        camera, seen, where = through.select(frames), targets, None
        if focus is not None and step % config.whole_every > 0 and len(scene.moving) > 0:
            look = focus(scene, int(drawn))
            scene, where = look.scene, look.where
            camera, seen = camera.cropped(look.rows, look.columns), targets.cropped(look.rows, look.columns)
        snapshot = scene.at(frames, camera.world_from_camera[:, :3, 3])
        density.watch(snapshot)
        rendering = render_snapshot(snapshot, camera, scene.near, backend)
        now = FitStep(scene, frames, rendering, seen, random, backend, where)
        values = {name: term(now) for name, (term, _) in terms.items()}
        loss: Float[Tensor, ""] | None = None
        if values:
            loss = torch.stack([terms[name][1] * value for name, value in values.items()]).sum()
            if poses is not None:
                loss = loss + poses.loss()
            _check(loss, step, frames)
        parameters.step(loss)
        density.after(step + 1, snapshot, camera)
        history.append({name: value.detach() for name, value in values.items()})
        progress(1)
        if enough(parameters.scene, targets.view, step + 1):
            break
    if len(history) < config.steps:
        progress(config.steps - len(history))
    camera = view.camera if poses is None else poses.result()
    seconds = time.perf_counter() - start
    return _result(parameters.result(), history, replace(view, camera=camera), held_out, backend, seconds)


@torch.no_grad()
def psnr(scene: DynamicScene, view: View, frames: Int[Tensor, " b"], backend: str = "auto") -> float:
    """Peak signal-to-noise ratio (dB) of the rendered against the recorded pictures, which are on one device."""
    frames = frames.to(view.rgb.device)
    rendered = render_scene(scene, view.camera.select(frames), frames, backend).rgb.clamp(0, 1)
    error = (rendered - view.rgb[frames].float() / 255).square().mean()
    return float(-10 * torch.log10(error.clamp(min=1e-10)))


class _Enough:
    """Whether held-out frames have stopped to improve."""

    def __init__(self, held_out: Int[Tensor, " b"], patience: int, backend: str) -> None:
        self.held_out, self.patience, self.backend = held_out, patience, backend
        self.best_db, self.best_step = 0.0, 0

    def __call__(self, scene: DynamicScene, view: View, steps: int) -> bool:
        if len(self.held_out) == 0 or steps % CHECK_STEPS != 0:
            return False
        now_db = psnr(scene, view, self.held_out, self.backend)
        if now_db > self.best_db + GAIN_DB:
            self.best_db, self.best_step = now_db, steps
        return steps - self.best_step >= self.patience


def _frames(count: int, held_out: int, seed: int) -> tuple[Iterator[Int[Tensor, "1"]], Int[Tensor, " b"]]:
    """The frames to train on, one by one without end, each once per round, and those that are held out.

    Of short videos, with fewer than ten frames for each that would be held out, none is.
    """
    generator = torch.Generator().manual_seed(seed)
    apart = torch.zeros(count, dtype=torch.bool)
    if held_out > 0 and count >= 10 * held_out:
        apart[evenly(count, held_out + 2)[1:-1]] = True
    train = (~apart).nonzero()[:, 0]

    def endless() -> Iterator[Int[Tensor, "1"]]:
        while True:
            yield from train[torch.randperm(len(train), generator=generator)].split(1)

    return endless(), apart.nonzero()[:, 0]


def _check(loss: Float[Tensor, ""], step: int, frames: Int[Tensor, "1"]) -> None:
    if not bool(torch.isfinite(loss)):
        raise EpisodeError(
            f"the fit diverged at step {step}, frame {int(frames)}: the loss is {loss.item()}; expected a finite "
            "number; look at this episode's depth, or lower fit.learning_rates"
        )


def _measured_shading(scene: DynamicScene, view: View, priors: Priors, backend: str) -> Shading:
    """The scene's brightness over time, that of the moving set as it is measured now."""
    shading = scene.shading or to_device(no_shading(len(scene.static), len(scene.moving), scene.frames), scene.device)
    gain = moving_gain(scene, view, priors, backend).to(scene.device)
    return replace(shading, moving=gain)


def _result(
    scene: DynamicScene,
    history: list[dict[str, Tensor]],
    view: View,
    held_out: Int[Tensor, " b"],
    backend: str,
    seconds: float,
) -> FitResult:
    last = history[-max(1, len(history) // 10) :]
    losses = {name: float(torch.stack([step[name] for step in last]).mean()) for name in (last[0] if last else {})}
    frames = evenly(len(view), SCORED_FRAMES)
    train_psnr_db = psnr(scene, to_device(view, scene.device), frames, backend)
    result = FitResult(scene, losses, train_psnr_db, len(history), seconds, held_out, view.camera)
    logger.info(
        "fit: %d + %d Gaussians, %d steps in %.0f s, %.1f dB on the recorded camera",
        len(scene.static),
        len(scene.moving),
        result.steps,
        result.seconds,
        result.train_psnr_db,
    )
    return result
