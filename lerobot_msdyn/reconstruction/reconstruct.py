"""View + Priors -> Reconstruction, as a list of named steps; nothing is written.

The job, the evaluations, the viewer, the cost estimate and the benchmarks run this one list. A caller that needs
another step in some place, as an ablation does, passes `with_steps(fit=its_own)`.
"""

import functools
import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from lerobot_msdyn.core.cameras import concatenated
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.observations import Priors, View
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.dataset.provenance import merged
from lerobot_msdyn.priors import estimate_priors
from lerobot_msdyn.priors.camera.path import CameraPath
from lerobot_msdyn.reconstruction.align_poses import keys_and_poses
from lerobot_msdyn.reconstruction.antialias import enlarged
from lerobot_msdyn.reconstruction.background import NEAR, look_at_distance
from lerobot_msdyn.reconstruction.evidence import Evidence, evidence_of
from lerobot_msdyn.reconstruction.fit import FitResult, fit
from lerobot_msdyn.reconstruction.initialise import initialise
from lerobot_msdyn.reconstruction.key_views import KeyView, fixed_view
from lerobot_msdyn.reconstruction.make_overlay import overlay_of
from lerobot_msdyn.reconstruction.make_short_lived import key_frames, short_lived_of
from lerobot_msdyn.reconstruction.pooled_background import (
    SharedBackground,
    adapted,
    completed,
    continued,
    differing,
    exchanged,
)
from lerobot_msdyn.reconstruction.prune import without_contradicted
from lerobot_msdyn.reconstruction.result import FittedWindow, Reconstruction
from lerobot_msdyn.reconstruction.self_check import SelfCheck, self_check
from lerobot_msdyn.reconstruction.share_background import moving_in_few, share_backgrounds
from lerobot_msdyn.reconstruction.shown_elsewhere import Shown, with_shown
from lerobot_msdyn.reconstruction.steady import steadied
from lerobot_msdyn.reconstruction.upright import up_of
from lerobot_msdyn.reconstruction.windows import Window, stands_of, whole_stands, windows
from lerobot_msdyn.render.cpu.threads import in_threads, torch_on_one_thread
from lerobot_msdyn.render.devices import chosen_device
from lerobot_msdyn.scene.dynamic import DynamicScene

logger = logging.getLogger(__name__)

FURTHER_STEPS = 0.6  # share of the fit's steps that suffices where the static set has been fitted already
WINDOWS_AT_ONCE = 2  # windows of a video that are worked on beside each other, where there are the cores


class StoppedError(Exception):
    """Nobody waits for the reconstruction any more."""


@dataclass(frozen=True)
class Handed:
    """What stands still as the first window from a place shows it, handed from each window to the next."""

    empty: Future[SharedBackground | None] = field(default_factory=Future)  # once its background is known
    fitted: Future[SharedBackground | None] = field(default_factory=Future)  # the same with a set, once that is fitted

    def fail(self, error: BaseException) -> None:
        """Let who waits for it fail as well."""
        for future in (self.empty, self.fitted):
            if not future.done():
                future.set_exception(error)


@dataclass
class Draft:
    """One window of a video on its way to a fitted scene; every step reads what earlier ones set, and sets its own."""

    start: int  # its first frame in the video
    view: View  # at the size at which it is fitted; from the step `priors` on with the camera that is used
    recipe: Recipe
    recorded_width: int  # px, of the video's own pictures
    estimate: Callable[..., Priors]  # (view, elsewhere=) -> the window's priors
    backgrounds: Sequence[SharedBackground]
    progress: Callable[[float], object]
    device: torch.device
    elsewhere: Sequence[Shown] = ()  # what other episodes show before a camera that moves
    path: CameraPath | None = None  # from the camera's usual place to where it is at each frame; None: it keeps still
    shared: SharedBackground | None = None  # the one that fits this window
    before: Handed | None = None  # by the window before this one
    handed: Handed = field(default_factory=Handed)  # by this one
    differs: Bool[Tensor, "h w"] | None = None  # where it is not what the first window shows; None: it is the first
    priors: Priors = field(init=False)
    keys: Sequence[KeyView] = field(init=False)  # what stands still
    distance: float = field(init=False)  # m, to the look-at point
    up: tuple[float, float, float] = field(init=False)  # the vertical in the camera's axes
    scene: DynamicScene = field(init=False)
    fitted: FitResult = field(init=False)
    evidence: Evidence = field(init=False)
    self_check: SelfCheck = field(init=False)
    seconds: dict[str, float] = field(default_factory=dict)  # by step

    def stand_before(self, keys: Sequence[KeyView]) -> None:
        """Take what stands still as given, and how the camera stands to it."""
        self.keys = keys
        depth = keys[0].empty.depth
        self.distance = look_at_distance(depth)
        if self.view.robot is None:
            up = up_of(depth, self.view.camera.intrinsics[0], self.recipe.camera.tilt_deg)
            turn = self.view.camera.camera_from_world[0, :3, :3] @ keys[0].camera.world_from_camera[0, :3, :3]
            x, y, z = up if self.view.camera.is_static else (turn @ torch.tensor(up)).tolist()
            self.up = x, y, z
        else:  # its world's z axis
            x, y, z = self.view.camera.camera_from_world[0, :3, 2].tolist()
            self.up = x, y, z

    def hand_on(self, done: str) -> None:
        """Give what stands still to the next window, once a step has found it."""
        if done in ("background", "fit"):
            future = "empty" if done == "background" else "fitted"
            first = None if self.before is None else getattr(self.before, future).result()
            if self.differs is None and self.view.camera.is_static:
                static = None if done == "background" else to_device(self.fitted.scene.static, "cpu")
                camera = self.view.camera.select([0])
                first = SharedBackground(self.keys[0].empty, camera, self.view.rgb[:0], static)
            getattr(self.handed, future).set_result(first)

    def made(self) -> "Made":
        """What all steps have made, on the host."""
        scene, evidence = to_device((self.scene.decomposed(), self.evidence), "cpu")
        fitted, priors = self.fitted, self.priors
        window = FittedWindow(
            self.start, scene, evidence, self.self_check, fitted.steps, fitted.train_psnr_db, self.seconds
        )
        return Made(window, priors.metric, priors.provenance, self.distance, self.up)


@dataclass(frozen=True)
class Made:
    """What is left of a draft."""

    window: FittedWindow
    metric: bool
    provenance: dict[str, dict[str, str]]
    distance: float
    up: tuple[float, float, float]


Step = Callable[[Draft], None]


def _steady(draft: Draft) -> None:
    """The video as a camera that keeps still would have recorded it."""
    if draft.path is not None:
        draft.view = steadied(draft.view, draft.path)


def _priors(draft: Draft) -> None:
    """What the video says before any fit; and the camera."""
    shared = next((background for background in draft.backgrounds if background.fits(draft.view)), None)
    draft.priors = draft.estimate(draft.view, elsewhere=None if shared is None else shared.frames)
    draft.view = replace(draft.view, camera=draft.priors.camera or draft.view.camera)
    if shared is not None and shared.fits(draft.view):  # it may be another camera than was assumed at first
        draft.shared = shared


def _background(draft: Draft) -> None:
    """What the camera sees where nothing moves, and how it stands to it."""
    refine = draft.recipe.camera.refine_poses
    draft.view, keys = keys_and_poses(draft.view, draft.priors, refine=refine)
    elsewhere = [other for other in draft.elsewhere if other.fits(draft.view)]
    if elsewhere:
        measured = draft.priors.depth_traits.measured
        keys = with_shown(keys, draft.view, elsewhere, refine=refine, measured=measured)
    if draft.shared is not None:
        keys = fixed_view(completed(keys[0].empty, draft.shared.empty, len(draft.view)), draft.view.camera)
    first = None if draft.before is None else draft.before.empty.result()
    if first is not None and first.fits(draft.view):
        empty = keys[0].empty
        draft.differs = differing(first.empty, empty)
        keys = fixed_view(continued(first.empty, empty, draft.differs), draft.view.camera)
    draft.stand_before(keys)


def _initial_scene(draft: Draft) -> None:
    """Static and moving Gaussians, and the motion of the latter."""
    scene = initialise(draft.view, draft.priors, draft.recipe.scene, draft.recipe.motion, draft.keys)
    if draft.shared is not None and draft.shared.static is not None:
        scene = replace(scene, static=adapted(draft.shared, draft.keys[0].empty, scene.static))
    scene = _continued(scene, draft)
    draft.scene = replace(scene, near=NEAR * draft.distance)


def _fit(draft: Draft) -> None:
    """Gaussians that show the recorded pictures."""
    config = draft.recipe.fit
    if draft.shared is not None and draft.shared.static is not None:
        config = replace(config, steps=round(FURTHER_STEPS * config.steps))
    scene = to_device(draft.scene, draft.device)
    draft.fitted = fit(
        scene if config.learn.motion else scene.composed(),
        draft.view,
        draft.priors,
        config,
        empty=draft.keys[0].empty.rgb,
        distance=draft.distance,
        seed=draft.recipe.seed,
        progress=lambda done: draft.progress(done / config.steps),
    )
    draft.scene = _continued(draft.fitted.scene, draft)
    draft.view = replace(draft.view, camera=draft.fitted.camera)


def _continued(scene: DynamicScene, draft: Draft) -> DynamicScene:
    """With what stands still as it was fitted in the first window, so that nothing jumps where the next one begins."""
    if draft.differs is None or draft.before is None:
        return scene
    first = draft.before.fitted.result()
    if first is None or first.static is None or len(scene.static) != len(first.static):
        return scene  # density control gives every window Gaussians of its own
    return replace(scene, static=exchanged(to_device(first.static, scene.device), scene.static, draft.differs))


def _prune(draft: Draft) -> None:
    """Without moving Gaussians that the video contradicts; where depth is measured, depth has done that."""
    if not draft.priors.depth_traits.measured:
        draft.scene = without_contradicted(draft.scene, draft.view)


def _evidence(draft: Draft) -> None:
    """What the recorded camera has shown of the scene."""
    draft.evidence = evidence_of(draft.scene, draft.view.camera, draft.keys)


def _short_lived(draft: Draft) -> None:
    """What the scene does not explain of some frames, for a few frames."""
    reach = draft.recipe.scene.short_lived
    if reach > 0:
        short_lived = short_lived_of(draft.scene, draft.view, draft.priors, reach)
        draft.scene = replace(draft.scene, short_lived=to_device(short_lived, draft.scene.device))


def _overlay(draft: Draft) -> None:
    """Recorded pixels of single frames that the scene does not explain."""
    if draft.recipe.scene.overlay:
        reach = draft.recipe.scene.short_lived
        explained = key_frames(len(draft.view), reach) if reach > 0 else ()
        overlay = overlay_of(draft.scene, draft.view, draft.priors, explained=explained)
        draft.scene = replace(draft.scene, overlay=to_device(overlay, draft.scene.device))


def _self_check(draft: Draft) -> None:
    """How well the scene explains its own video."""
    held_out = draft.fitted.held_out
    draft.self_check = self_check(draft.scene, draft.view, draft.priors, held_out, draft.distance)


def _antialias(draft: Draft) -> None:
    """Gaussians that close their gaps at the size of the recorded pictures."""
    ratio = draft.recorded_width / draft.view.camera.width
    draft.scene = enlarged(draft.scene, draft.view.camera, ratio)


STEPS: dict[str, Step] = {
    "steady": _steady,
    "priors": _priors,
    "background": _background,
    "initial scene": _initial_scene,
    "fit": _fit,
    "prune": _prune,
    "evidence": _evidence,
    "short-lived": _short_lived,
    "overlay": _overlay,
    "self-check": _self_check,
    "antialias": _antialias,
}


def with_steps(others: dict[str, Step]) -> dict[str, Step]:
    """The steps with some of them, by name, exchanged for others.

    Raises:
        KeyError: there is no step of that name.
    """
    unknown = set(others) - set(STEPS)
    if unknown:
        raise KeyError(f"no step {', '.join(sorted(unknown))}; expected some of {', '.join(STEPS)}")
    return STEPS | others


def reconstruct(
    view: View,
    recipe: Recipe,
    progress: Callable[[float], object] = lambda share: None,
    backgrounds: Sequence[SharedBackground | Shown] = (),
    *,
    others: Sequence[View] = (),
    episode: int | None = None,
    key: str | None = None,
    steps: dict[str, Step] = STEPS,
) -> Reconstruction:
    """Priors, initial scene and fit of one camera's video; the first of the shared backgrounds that fits is used.

    Videos are cut where the camera was moved, and long ones into windows, each with priors and a scene of its own, so
    that memory beyond the video itself is that of two windows, which are worked on at once. Windows share a background
    as episodes do. The fit runs on the recipe's device; the result is on the host.

    Args:
        view: the video, at its own size.
        recipe: all settings.
        progress: called with the share of the work, 0..1, that was done since the last call.
        backgrounds: what several episodes of this camera show together, or each of some where it moves.
        others: videos of the same moments by other cameras, for stereo.
        episode: index of the episode, by which exchange files are found and checked.
        key: feature key of the camera, likewise.
        steps: what is done with each window, in this order.

    Raises:
        ConfigError: the recipe demands a device that cannot be used.
        EpisodeError: the fit diverges.
        PriorError: a prior was demanded and cannot be had.
    """
    stands = stands_of(view, recipe)
    parts = [part for whole in whole_stands(view, stands) for part in windows(whole, recipe)]
    if len(parts) > 1 and not backgrounds and recipe.scene.shared_background:
        backgrounds = _shared_by_windows(parts, recipe, episode, key)
    places = [background for background in backgrounds if isinstance(background, SharedBackground)]
    elsewhere = [shown for shown in backgrounds if isinstance(shown, Shown) and shown.episode != episode]
    small_others = [other.shrunk(recipe.fit.max_width) for other in others]
    device = chosen_device(recipe.device)
    stopped = threading.Event()

    def within(share: float) -> object:
        if stopped.is_set():
            raise StoppedError
        return progress(share / len(parts))

    def drafts() -> Iterator[Draft]:
        before: Handed | None = None
        for part in parts:
            frames = slice(part.start, part.start + len(part.view))
            estimate = functools.partial(
                estimate_priors,
                config=recipe.priors,
                camera=recipe.camera,
                others=[other.select(frames) for other in small_others],
                episode=episode,
                key=key,
                device=recipe.device,
            )

            small = part.view.shrunk(recipe.fit.max_width)
            path, width = part.path, view.camera.width
            draft = Draft(
                part.start, small, recipe, width, estimate, places, within, device, elsewhere, path, before=before
            )
            before = draft.handed
            yield draft

    at_once = min(WINDOWS_AT_ONCE, len(parts)) if device.type == "cpu" else 1
    made = [*in_threads(functools.partial(_made, steps, stopped), drafts(), at_once, stopped.set)]
    camera = concatenated([one.window.evidence.camera for one in made])
    return Reconstruction(
        windows=tuple(one.window for one in made),
        metric=all(one.metric for one in made),
        provenance=merged([one.provenance for one in made]),
        camera=camera.resized(view.camera.width, view.camera.height),
        distance=made[0].distance,
        up=made[0].up,
        stands=stands,
    )


def _made(steps: dict[str, Step], stopped: threading.Event, draft: Draft) -> Made:
    """What all steps make of a draft."""
    try:
        with torch_on_one_thread():
            for name, step in steps.items():
                if stopped.is_set():
                    raise StoppedError
                begin = time.perf_counter()
                step(draft)
                draft.seconds[name] = time.perf_counter() - begin
                draft.hand_on(name)
    except BaseException as error:
        draft.handed.fail(error)
        raise
    return draft.made()


def _shared_by_windows(
    parts: Sequence[Window], recipe: Recipe, episode: int | None, key: str | None
) -> list[SharedBackground]:
    """What the windows of one video show together."""

    def moving(numbers: Sequence[int], frames: Tensor) -> list[Tensor]:
        return [*in_threads(lambda number: moving_in_few(parts[number], recipe, frames, episode, key), numbers)]

    with torch_on_one_thread():
        return share_backgrounds([part.few_frames(recipe.fit.max_width) for part in parts], moving, recipe)
