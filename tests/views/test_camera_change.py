"""Camera changes: what is sampled, where the camera goes, and that it is the same every time."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch.quasirandom import SobolEngine

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.geometry import invert_se3
from lerobot_msdyn.core.perturbation import AMOUNTS, PERTURBATIONS, Perturbation
from lerobot_msdyn.reconstruction.background import look_at_distance
from lerobot_msdyn.scene.store import SavedScene, SceneSource
from lerobot_msdyn.views import camera_change
from lerobot_msdyn.views.camera_change import CameraChange, sample_change, units_of_shifts
from lerobot_msdyn.views.offsets import offsets, orbit_offset
from lerobot_msdyn.views.perturbations.dolly import Dolly
from lerobot_msdyn.views.perturbations.drift import Drift
from lerobot_msdyn.views.perturbations.focal import Focal
from lerobot_msdyn.views.perturbations.jitter import Jitter
from lerobot_msdyn.views.perturbations.orbit import Orbit
from lerobot_msdyn.views.perturbations.other_camera import OtherCamera
from lerobot_msdyn.views.perturbations.poses import Poses
from lerobot_msdyn.views.perturbations.rotation import Rotation
from lerobot_msdyn.views.perturbations.translation import Translation

FRAMES, DISTANCE = 5, 0.7
SAMPLED = (Orbit, Translation, Rotation, Dolly, Focal, Jitter, Drift)


def scene(
    pose: torch.Tensor | None = None, *, metric: bool = True, world: str = "", frames: int = FRAMES
) -> SavedScene:
    """A scene of nothing, with a camera that stands still."""
    camera = static_camera(intrinsics_from_fov(64, 48, 60.0), frames, 64, 48, pose)
    camera = dataclasses.replace(camera, world=world)
    return SavedScene(SceneSource("local/none", 0, "a", 30), (), (), camera, metric, DISTANCE, {})


def change(config: Perturbation, variant: int = 0, *, seed: int = 0, episode: int = 1, **of_scene: Any) -> CameraChange:
    return sample_change(config, {"a": scene(**of_scene)}, seed, episode, variant)


def amounts(config: Perturbation, variant: int = 0, **options: Any) -> torch.Tensor:
    return change(config, variant, **options).amounts["a"]


@pytest.mark.parametrize("kind", SAMPLED)
def test_samples_are_a_function_of_seed_episode_variant_and_attempt(kind: type[Perturbation]) -> None:
    def sample(seed: int, episode: int, variant: int, attempt: int = 0) -> torch.Tensor:
        return sample_change(kind(), {"a": scene()}, seed, episode, variant, attempt).amounts["a"]

    first = sample(0, 1, 2)
    assert torch.equal(first, sample(0, 1, 2))
    for key in ((1, 1, 2), (0, 2, 2), (0, 1, 3), (0, 1, 2, 1)):
        assert not torch.equal(first, sample(*key))


@pytest.mark.parametrize("variants", [2, 4, 8])
def test_variants_are_spread_over_the_range(variants: int) -> None:
    config = Orbit(azimuth_deg=1.0, elevation_deg=1.0, translation_m=1.0)
    samples = torch.cat([amounts(config, variant, seed=3, episode=7) for variant in range(variants)])[:, :5]
    strata = ((samples + 1) / 2 * variants).floor()
    for column in strata.T:
        assert sorted(column.tolist()) == list(range(variants))


@pytest.mark.parametrize("seed", range(4))
def test_few_episodes_fill_the_ranges_evenly(seed: int) -> None:
    config = Orbit(azimuth_deg=1.0, elevation_deg=1.0, translation_m=1.0)
    samples = torch.cat([amounts(config, v, seed=seed, episode=e) for e in range(32) for v in range(2)])[:, :5]
    for column in samples.T:
        assert (torch.histc(column, bins=8, min=-1, max=1) - 8).abs().max() <= 1  # at random by 4 or more
    assert (torch.corrcoef(samples.T) - torch.eye(5)).square().mean().sqrt() < 0.05  # at random 0.11


@pytest.mark.parametrize("seed", [None, 5])
def test_digits_are_those_of_the_sequence(seed: int | None) -> None:
    for first in (0, 100_000):
        engine = SobolEngine(camera_change.DIMENSIONS, scramble=seed is not None, seed=seed).fast_forward(first)
        for index, point in enumerate(engine.draw(70, dtype=torch.float64)):
            digits = torch.from_numpy(camera_change.sobol_digits(seed, first + index))
            assert (digits / 2**30 - point).abs().max() < 1e-7  # torch keeps the first point in single precision


def test_with_per_frame_every_frame_has_its_own_sample() -> None:
    assert len(amounts(Orbit())) == 1
    rows = amounts(Orbit(per_frame=True))
    assert len(rows.unique(dim=0)) == FRAMES


@pytest.mark.parametrize(
    ("config", "bounds"),
    [
        (Orbit(azimuth_deg=4.0, elevation_deg=2.0, translation_m=0.1), [4, 2, 0.1, 0.1, 0.1, 0, 0, 0, 0, 0, 0]),
        (Translation(translation_m=0.1), [0, 0, 0.1, 0.1, 0.1, 0, 0, 0, 0, 0, 0]),
        (Rotation(pan_deg=1.0, tilt_deg=2.0, roll_deg=3.0), [0, 0, 0, 0, 0, 0, 0, 3, 1, 2, 0]),
        (Dolly(translation_m=0.1), [0, 0, 0, 0, 0.1, 0, 0, 0, 0, 0, 0]),
        (Focal(zoom=0.2), [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, math.log(1.2)]),
        (Drift(azimuth_deg=4.0, elevation_deg=2.0, translation_m=0.1), [4, 2, 0.1, 0.1, 0.1, 0, 0, 0, 0, 0, 0]),
    ],
    ids=lambda value: type(value).__name__,
)
def test_samples_lie_in_the_range(config: Perturbation, bounds: list[float]) -> None:
    largest = torch.cat([amounts(config, variant) for variant in range(32)]).abs().amax(0)
    assert (largest <= torch.tensor(bounds) + 1e-6).all()
    assert (largest >= 0.8 * torch.tensor(bounds)).all()


def test_orbit_turns_further_where_the_scale_is_metric_unless_told_how_far() -> None:
    def largest(config: Orbit, *, metric: bool) -> float:
        return float(torch.cat([amounts(config, variant, metric=metric) for variant in range(32)])[:, 0].abs().max())

    assert 12 < largest(Orbit(), metric=True) <= 15
    assert 8 < largest(Orbit(), metric=False) <= 10
    assert 4 < largest(Orbit(azimuth_guessed_deg=5.0), metric=False) <= 5
    for metric in (True, False):
        assert 3.2 < largest(Orbit(azimuth_deg=4.0), metric=metric) <= 4


def test_jitter_is_normally_distributed() -> None:
    samples = torch.cat([amounts(Jitter(rotation_deg=2.0), variant) for variant in range(256)])[:, 5:8]
    assert samples.std(0).tolist() == pytest.approx([2.0] * 3, rel=0.05)
    assert (samples.abs() > 4.0).float().mean() == pytest.approx(0.0455, abs=0.02), "beyond two standard deviations"
    assert samples.abs().max() <= 6.0


def test_shifts_are_metres_where_these_are_true_and_else_shares_of_the_distance() -> None:
    config = Translation(translation_m=0.1, translation_rel=0.5)
    ratio = amounts(config, metric=False)[0, 2:5] / amounts(config)[0, 2:5]
    torch.testing.assert_close(ratio, torch.full((3,), 0.5 * DISTANCE / 0.1))
    assert set(change(config).described()["a"]) == {"shift_x_m", "shift_y_m", "shift_z_m"}
    rel = change(config, metric=False).described()["a"]
    assert abs(rel["shift_x_rel"]) <= 0.5


def test_drift_is_smooth() -> None:
    azimuth = amounts(Drift(azimuth_deg=6.0, cycles=0.5), episode=0, frames=100)[:, 0]
    assert float(azimuth.diff().abs().max()) < 0.5
    assert float(azimuth.max() - azimuth.min()) > 0.1


def test_the_change_at_one_frame_holds_for_all() -> None:
    whole = change(Drift(), frames=9)
    camera = whole.at(4).cameras()["a"]
    assert camera.is_static
    torch.testing.assert_close(camera.world_from_camera[0], whole.cameras()["a"].world_from_camera[4])
    one = change(Orbit())
    assert torch.equal(one.at(4).amounts["a"], one.amounts["a"])


def test_a_given_pose_is_reached_and_half_of_it_is_half_way() -> None:
    pose = invert_se3(orbit_offset(20.0, 5.0, DISTANCE))
    given = change(Poses(poses=[pose[:3].flatten().tolist()]))
    whole = given.cameras()["a"].camera_from_world[0]
    torch.testing.assert_close(whole, pose, atol=1e-5, rtol=0)
    half = given.cameras(0.5)["a"].world_from_camera[0]
    torch.testing.assert_close(half[:3, 3], 0.5 * invert_se3(pose)[:3, 3], atol=1e-5, rtol=0)


def test_another_cameras_pose() -> None:
    other = orbit_offset(25.0, -5.0, DISTANCE)
    front = scene(orbit_offset(-10.0, 0.0, DISTANCE), world="calibration")
    found = sample_change(OtherCamera(camera="side"), {"a": front}, 0, 0, 0, other=other).cameras()["a"]
    torch.testing.assert_close(found.world_from_camera[2], other, atol=1e-5, rtol=0)
    with pytest.raises(ConfigError, match="'other_camera' needs the pose of camera 'side', which is not kept"):
        sample_change(OtherCamera(camera="side"), {"a": front}, 0, 0, 0)


def test_a_longer_focal_length_keeps_the_principal_point() -> None:
    whole = change(Focal())
    rows = torch.zeros(1, len(AMOUNTS))
    rows[0, -1] = math.log(1.5)
    found = dataclasses.replace(whole, amounts={"a": rows}).cameras()["a"].intrinsics[0]
    recorded = whole.views["a"].camera.intrinsics[0]
    torch.testing.assert_close(found[:2, :2], 1.5 * recorded[:2, :2])
    assert torch.equal(found[:, 2], recorded[:, 2])


@pytest.mark.parametrize(("kind", "moves_rig"), [(Orbit, True), (Translation, True), (Drift, True), (Jitter, False)])
def test_calibrated_cameras_move_as_one_body_others_each_by_itself(kind: type[Perturbation], moves_rig: bool) -> None:
    poses = [orbit_offset(0.0, 0.0, DISTANCE), orbit_offset(40.0, 10.0, DISTANCE)]
    for world, rigid in (("calibration", moves_rig), ("", False)):
        scenes = {str(i): scene(pose, world=world) for i, pose in enumerate(poses)}
        both = sample_change(kind(), scenes, 0, 1, 0)
        cameras = both.cameras()
        a, b = (cameras[key].world_from_camera[-1] for key in "01")
        between, before = invert_se3(a) @ b, invert_se3(poses[0]) @ poses[1]
        assert torch.allclose(between, before, atol=1e-5) == rigid
        torch.testing.assert_close(a, poses[0] @ offsets(both.amounts["0"], DISTANCE)[-1])


def test_nothing_allowed_means_nothing_changes() -> None:
    for config in (Orbit(azimuth_deg=0.0, elevation_deg=0.0, translation_m=0.0), Focal(zoom=0.0)):
        camera, recorded = change(config).cameras()["a"], scene().camera
        torch.testing.assert_close(camera.world_from_camera, recorded.world_from_camera)
        torch.testing.assert_close(camera.intrinsics, recorded.intrinsics)


class Wrong(Perturbation):
    """What a user's own kind may get wrong."""

    def __init__(self, bounds: dict[str, float], rows: int = 1, value: float = 1.0) -> None:
        super().__init__()
        self.given, self.rows, self.value = bounds, rows, value

    def bounds(self, view: object) -> dict[str, float]:
        return self.given

    def shares(self, uniform: np.ndarray, phases: np.ndarray, frames: int) -> np.ndarray:
        return np.full((self.rows, len(AMOUNTS)), self.value, np.float32)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (Perturbation(), "'Perturbation' has no bounds; expected a method bounds"),
        (Wrong({"azimut_deg": 3.0}), "'Wrong' bounds azimut_deg; expected some of azimuth_deg, elevation_deg"),
        (Wrong({}, rows=2), r"amounts of shape \[2, 11\]; expected finite numbers, 11 in each of 1 or 5 rows"),
        (Wrong({}, value=math.nan), "expected finite numbers"),
    ],
    ids=["no bounds", "unknown amount", "rows", "not a number"],
)
def test_what_a_kind_gets_wrong_is_one_line(config: Perturbation, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        amounts(config)
    assert "\n" not in str(caught.value)


def test_every_built_in_kind_is_a_file_that_registers_itself_and_reads_its_fields() -> None:
    import inspect

    names = ["dolly", "drift", "focal", "jitter", "orbit", "other_camera", "poses", "rotation", "translation"]
    assert PERTURBATIONS.names() == names
    for name, kind in Perturbation.get_known_choices().items():
        module = inspect.getmodule(kind)
        assert module is not None
        source = inspect.getsource(module)
        for field in dataclasses.fields(kind):
            assert field.name == "per_frame" or f"self.{field.name}" in source, f"{name}.{field.name}"


def test_look_at_distance_is_that_of_the_middle() -> None:
    depth = torch.full((8, 8), 5.0)
    depth[2:6, 2:6] = 0.7
    depth[3, 3] = 0
    assert look_at_distance(depth) == pytest.approx(0.7)
    assert look_at_distance(torch.zeros(8, 8)) == 1.0


def test_the_summary_says_in_which_unit_cameras_were_shifted() -> None:
    metres = change(Orbit()).described()["a"]
    episodes = [{"front": metres, "side": metres}, {"top": change(Orbit(), metric=False).described()["a"]}]
    line = "metres (front, side) and shares of the look-at distance, as depth has no true scale (top)"
    assert units_of_shifts(episodes) == f"shifts are {line}\n"
    assert units_of_shifts(episodes[:1]) == "shifts are metres (front, side)\n"
    assert units_of_shifts([{}, {"front": change(Rotation()).described()["a"]}]) == ""
