"""Tests that can fail: the whole way from a video to new views, and what happens to its checks if a step is wrong.

One synthetic episode is reconstructed from its exact depth, masks and tracks, without overlays (recorded pixels would
hide what motion gets wrong). `failures` holds the result against the truth; every mutant below must fail it.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import Bool, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import GateConfig, Recipe
from lerobot_msdyn.core.observations import PointTracks, Priors, View
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.priors.exchange import from_priors, write_exchange
from lerobot_msdyn.reconstruction.reconstruct import STEPS, Draft, Step, reconstruct, with_steps
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.scene.overlay import Overlay, packed
from lerobot_msdyn.synthetic import SyntheticScene, SyntheticTracks, covisibility, heldout_cameras, make_scene
from lerobot_msdyn.views import gate, offsets, pictures
from lerobot_msdyn.views.new_cameras import new_cameras
from lerobot_msdyn.views.perturbations.orbit import Orbit
from lerobot_msdyn.views.pictures import new_pictures

pytestmark = pytest.mark.slow

FRAMES, WIDTH, HEIGHT, TRACKS = 20, 112, 84, 200
KEY = "observation.images.front"
HELD_OUT = ("az+05", "el+08")  # cameras
VARIANT = 4  # of a new episode, whose camera is well to one side
SHOWN = list(range(1, FRAMES, 3))  # frames that are compared
# What must be reached. Measured: 26.6 and 20.3 dB, 25.7 and 19.6 dB; the best mutant of motion 25.5, 19.3, 24.6, 17.3.
LIMITS_DB = {"az+05": (26.0, 19.6), "el+08": (26.0, 19.6), "sampled camera": (25.1, 18.6)}  # PSNR, dynamic PSNR
MEDIAN_M, MOST_M = 0.0045, 0.016  # error of points on what moves, half of them and nine of ten; measured: 2.7, 10.0 mm
COVERED = 0.03  # share of the picture by which the covered part may be misjudged; measured: 0.019, a blind one 0.06
GATE = GateConfig(min_expected_db=24.0)
NEAR_DEG, FAR_DEG = 3.0, 45.0  # a view that the gate must keep, and one that it must reject


@dataclass(frozen=True)
class Truth:
    """What a camera truly sees at some frames."""

    camera: CameraTrack
    rgb: UInt8[ndarray, "n h w 3"]
    covered: Bool[ndarray, "n h w"]  # seen by the recorded camera at any time
    moving: Bool[ndarray, "n h w"]

    def psnr_db(self, rendered: UInt8[ndarray, "n h w 3"], where: Bool[ndarray, "n h w"]) -> float:
        error = (rendered.astype(np.float64) - self.rgb)[where]
        return float(10 * np.log10(255**2 / np.square(error).mean()))


@dataclass(frozen=True)
class Case:
    """An episode, the truth about it, and what of its reconstruction is the same for most mutants."""

    scene: SyntheticScene
    view: View
    tracks: SyntheticTracks
    held_out: dict[str, Truth]
    recipe: Recipe
    after: dict[str, dict[str, Any]]  # step -> what the honest draft holds after it

    def reconstructed(self, changed: dict[str, Step] | None = None, *, overlay: bool = False) -> Reconstruction:
        """With some steps changed: those before the first of them are not taken again."""
        recipe = replace(self.recipe, scene=replace(self.recipe.scene, overlay=overlay))
        first = [name for name in STEPS if name in (changed or {}) or (overlay and name == "overlay")][:1]
        steps = with_steps(dict(changed or {}))
        for name in STEPS:
            if [name] == first:
                break
            steps[name] = self.remembered(name)
        return reconstruct(self.view, recipe, steps=steps)

    def remembered(self, name: str) -> Step:
        """An honest step that is taken once."""

        def step(draft: Draft) -> None:
            if name not in self.after:
                STEPS[name](draft)
                self.after[name] = dict(vars(draft))
            vars(draft).update(
                {key: value for key, value in self.after[name].items() if key not in ("seconds", "recipe")}
            )

        return step


def truth_of(scene: SyntheticScene, depth: Tensor, camera: CameraTrack) -> Truth:
    camera = camera.select(SHOWN)
    seen = scene.render(camera, SHOWN)
    covered = covisibility(scene, depth.numpy(), camera, SHOWN) > 0
    return Truth(camera, seen.rgb.numpy(), covered, seen.instances.numpy() > 0)


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    scene = make_scene("push", 0, FRAMES, WIDTH, HEIGHT)
    assert scene.instance_names == ("background", "robot", "block")
    seen, tracks = scene.render(scene.camera), scene.tracks(TRACKS)
    view = View(seen.rgb, scene.camera, seen.depth)
    points = PointTracks(tracks.xy, tracks.visible, torch.ones(tracks.xy.shape[:2]), tracks.instance)
    path = tmp_path_factory.mktemp("mutants") / "priors.npz"
    write_exchange(path, from_priors(view, Priors(seen.depth, seen.instances, points), 0, KEY))
    recipe = Recipe()
    recipe.priors.masks = recipe.priors.tracks = str(path)
    recipe.fit.steps = 40
    cameras = heldout_cameras(FRAMES, WIDTH, HEIGHT)
    held_out = {name: truth_of(scene, seen.depth, cameras[name]) for name in HELD_OUT}
    return Case(scene, view, tracks, held_out, recipe, {})


def failures(case: Case, scene: Reconstruction) -> list[str]:
    """What does not hold of a reconstruction; empty for a good one."""
    return [
        *pictures_fail(case, scene),
        *motion_fails(case, scene),
        *sampled_cameras_fail(case, scene),
        *gate_fails(case, scene),
    ]


def pictures_fail(case: Case, scene: Reconstruction) -> Iterator[str]:
    """Views from cameras that were not fitted, against what they truly see."""
    for name, truth in case.held_out.items():
        yield from differences(scene, truth, name)


def differences(scene: Reconstruction, truth: Truth, name: str) -> Iterator[str]:
    shown = list(new_pictures(scene, truth.camera, torch.tensor(SHOWN)))
    rendered = np.stack([picture.rgb for picture in shown])
    everywhere, moving = truth.psnr_db(rendered, truth.covered), truth.psnr_db(rendered, truth.covered & truth.moving)
    limit, dynamic_limit = LIMITS_DB[name]
    if everywhere < limit:
        yield f"{name}: PSNR {everywhere:.1f} dB"
    if moving < dynamic_limit:
        yield f"{name}: dynamic PSNR {moving:.1f} dB"
    off = np.mean([picture.unseen for picture in shown]) - (~truth.covered).mean()
    if abs(off) > COVERED:
        yield f"{name}: uncovered share off by {off:+.3f}"


def motion_fails(case: Case, scene: Reconstruction) -> Iterator[str]:
    """Every true point is carried by the Gaussian that is nearest to it in the frame in which it was picked."""
    dynamic = scene.windows[0].scene
    if len(dynamic.moving) == 0:
        yield "motion off: nothing moves"
        return
    means = dynamic.at(torch.arange(FRAMES)).means[:, len(dynamic.static) :]
    tracks, errors = case.tracks, []
    for point, picked in enumerate(tracks.query.tolist()):
        offsets_at_pick = means[picked] - tracks.positions[point, picked]
        nearest = offsets_at_pick.norm(dim=-1).argmin()
        carried = means[:, nearest] - offsets_at_pick[nearest]
        errors.append((carried - tracks.positions[point]).norm(dim=-1)[tracks.visible[point]])
    error = torch.cat(errors)
    median, most = float(error.median()), float(error.quantile(0.9))
    if median > MEDIAN_M or most > MOST_M:
        yield f"motion off by {1000 * median:.1f} mm, nine of ten points by less than {1000 * most:.1f} mm"


def sampled_cameras_fail(case: Case, scene: Reconstruction) -> Iterator[str]:
    """The pictures of a new episode show what a camera sees that is placed where the record says, by other code."""
    recipe = replace(case.recipe, perturbation=Orbit(elevation_deg=0.0, translation_m=0.0))
    sampled = new_cameras({KEY: scene}, recipe, 0, VARIANT)
    degrees = sampled.amounts[KEY]["azimuth_deg"]
    assert abs(degrees) > 5
    depth = case.view.depth
    assert depth is not None
    truth = truth_of(case.scene, depth, turned_right(case.scene.camera, degrees, scene.distance))
    yield from differences(scene, replace(truth, camera=sampled.cameras[KEY].select(SHOWN)), "sampled camera")


def turned_right(camera: CameraTrack, degrees: float, distance: float) -> CameraTrack:
    """A camera that goes to its right on a level circle about the point `distance` (m) before it, and looks at it."""
    angle, recorded = math.radians(degrees), camera.world_from_camera[0]
    point = recorded[:3, 3] + distance * recorded[:3, 2]
    turn = torch.eye(4)
    turn[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    turn[:3, 3] = point - turn[:3, :3] @ point
    return replace(camera, world_from_camera=turn @ camera.world_from_camera)


def gate_fails(case: Case, scene: Reconstruction) -> Iterator[str]:
    """A view close by is kept; one from far off, and any of a scene that lost what moves, is not."""
    near, far = (
        gate.judge(scene.windows, turned_right(case.scene.camera, degrees, scene.distance))
        for degrees in (NEAR_DEG, FAR_DEG)
    )
    if gate.reasons(near, GATE):
        yield f"gate rejects a good view: {gate.reasons(near, GATE)[0]}"
    if not gate.reasons(far, GATE):
        yield f"gate keeps a bad view, of {far.expected_db:.1f} dB expected"


def check(case: Case, scene: Reconstruction) -> None:
    """The assertion that mutants must fail."""
    failed = failures(case, scene)
    assert not failed, "; ".join(failed)


@pytest.mark.parametrize("overlay", [False, True])
def test_the_honest_pipeline_passes(case: Case, *, overlay: bool) -> None:
    check(case, case.reconstructed(overlay=overlay))


def identity_motion(case: Case, draft: Draft) -> None:
    """Nothing moves."""
    still = [torch.tensor([1.0, 0, 0, 0, 1, 0]).expand_as(level.rotations_6d) for level in bases(draft)]
    levels = tuple(
        replace(level, rotations_6d=rotation, displacements=torch.zeros_like(level.displacements))
        for level, rotation in zip(bases(draft), still, strict=True)
    )
    draft.scene = replace(draft.scene, levels=levels)


def bases(draft: Draft) -> list[MotionLevel]:
    """Its levels, all of which are of bases."""
    return [level for level in draft.scene.levels if isinstance(level, MotionLevel)]


def late_motion(case: Case, draft: Draft) -> None:
    """All motion comes one frame late."""
    levels = tuple(replace(level, knots=level.knots + 1) for level in bases(draft))
    draft.scene = replace(draft.scene, levels=levels)


def shifts_alone(case: Case, draft: Draft) -> None:
    """What moves does not turn."""
    levels = tuple(
        replace(level, rotations_6d=torch.tensor([1.0, 0, 0, 0, 1, 0]).expand_as(level.rotations_6d))
        for level in bases(draft)
    )
    draft.scene = replace(draft.scene, levels=levels)


def swapped_instances(case: Case, draft: Draft) -> None:
    """The masks of the two things that move are exchanged; their tracks are not."""
    instances = draft.priors.instances
    draft.priors = replace(draft.priors, instances=torch.where(instances > 0, 3 - instances, instances))


def deeper(case: Case, draft: Draft) -> None:
    """All depth is 20 % too large."""
    draft.priors = replace(draft.priors, depth=1.2 * draft.priors.depth)


def nothing_moves(case: Case, draft: Draft) -> None:
    """The moving set is lost."""
    draft.scene = draft.scene.select_moving(slice(0))


MUTANTS: dict[str, tuple[str, Callable[[Case, Draft], None], str]] = {
    # name: after which step, what is changed, and what of `check` has to fail
    "identity motion": ("initial scene", identity_motion, "dynamic PSNR.*motion off"),
    "swapped instances": ("priors", swapped_instances, "dynamic PSNR.*motion off"),
    "motion one frame late": ("initial scene", late_motion, "dynamic PSNR.*motion off"),
    "no rotation": ("initial scene", shifts_alone, "motion off"),
    "depth 20 % too large": ("priors", deeper, "el.08: PSNR"),
    "moving set lost": ("fit", nothing_moves, "dynamic PSNR"),
}


@pytest.mark.parametrize("name", MUTANTS)
def test_mutants_of_the_reconstruction_fail(case: Case, name: str) -> None:
    step, change, reason = MUTANTS[name]

    def mutant(draft: Draft) -> None:
        case.remembered(step)(draft)
        change(case, draft)

    scene = case.reconstructed({step: mutant})
    with pytest.raises(AssertionError, match=reason):
        check(case, scene)


def test_an_overlay_of_the_frame_before_fails(case: Case) -> None:
    def mutant(draft: Draft) -> None:
        STEPS["overlay"](draft)
        overlay = draft.scene.overlay
        assert isinstance(overlay, Overlay)
        own = len(draft.scene.static) + len(draft.scene.moving)
        patches = [overlay.patch(frame, own) for frame in range(FRAMES)]
        draft.scene = replace(draft.scene, overlay=packed([patches[0], *patches[:-1]]))

    scene = case.reconstructed({"overlay": mutant}, overlay=True)
    with pytest.raises(AssertionError, match="dynamic PSNR"):
        check(case, scene)


def test_mutants_of_the_views_fail(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reconstruction is the honest one."""
    scene, render, orbit = case.reconstructed(), pictures.render_frames, offsets.orbit_offset
    recorded = case.scene.camera.world_from_camera[0]
    expected_error, coverage_of = gate.expected_error, pictures.coverage_of

    def mirrored(dynamic: Any, camera: CameraTrack, *rest: Any, **named: Any) -> Any:
        flip = torch.diag(torch.tensor([-1.0, 1, 1, 1]))
        pose = recorded @ flip @ recorded.inverse() @ camera.world_from_camera @ flip
        return render(dynamic, replace(camera, world_from_camera=pose), *rest, **named)

    def next_frame(dynamic: Any, camera: CameraTrack, frames: Tensor, **named: Any) -> Any:
        return render(dynamic, camera, (frames + 1).clamp(max=FRAMES - 1), **named)

    def other_side(azimuth: Any, *rest: Any) -> Any:
        return orbit(-azimuth, *rest)

    def same_everywhere(check_: Any, new: CameraTrack) -> Any:
        return expected_error(check_, check_.camera)

    def all_covered(*arguments: Any) -> Any:
        return [replace(each, unseen=np.zeros_like(each.unseen)) for each in coverage_of(*arguments)]

    for module, name, mutant, reason in (
        (pictures, "render_frames", mirrored, "az.05: PSNR"),
        (pictures, "render_frames", next_frame, "dynamic PSNR"),
        (offsets, "orbit_offset", other_side, "sampled camera: PSNR"),
        (gate, "expected_error", same_everywhere, "gate keeps a bad view"),
        (gate, "reasons", lambda *_: [], "gate keeps a bad view"),
        (gate, "reasons", lambda *_: ["bad"], "gate rejects a good view"),
        (pictures, "coverage_of", all_covered, "uncovered share off"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, mutant)
            with pytest.raises(AssertionError, match=reason):
                check(case, scene)
