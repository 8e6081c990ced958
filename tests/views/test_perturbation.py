"""Camera changes: where the camera goes, and that it is the same every time."""

import dataclasses
import math

import pytest
import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.config import (
    DollyConfig,
    DriftConfig,
    FocalConfig,
    JitterConfig,
    OrbitConfig,
    OtherCameraConfig,
    PerturbationConfig,
    PosesConfig,
    RotationConfig,
    TranslationConfig,
)
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.geometry import invert_se3, transform_points
from lerobot_msdyn.reconstruction.background import look_at_distance
from lerobot_msdyn.views.perturbation import (
    AMOUNTS,
    Viewpoint,
    amounts_of,
    described,
    draw,
    moved,
    offsets,
    orbit_offset,
    units_of_shifts,
)

FRAMES, DISTANCE = 5, 0.7
KINDS = (OrbitConfig, TranslationConfig, RotationConfig, DollyConfig, FocalConfig, JitterConfig, DriftConfig)


def viewpoint(pose: torch.Tensor | None = None, *, metric: bool = True, origin: str = "assumed") -> Viewpoint:
    camera = static_camera(intrinsics_from_fov(64, 48, 60.0), FRAMES, 64, 48, pose)
    return Viewpoint(dataclasses.replace(camera, origin=origin), DISTANCE, metric)


def amounts(config: PerturbationConfig, variant: int = 0, *, metric: bool = True, seed: int = 0) -> torch.Tensor:
    return amounts_of(config, draw(config, seed, 1, variant, FRAMES), viewpoint(metric=metric), variant)


def test_orbit_keeps_the_distance_and_looks_at_the_point() -> None:
    target = torch.tensor([[0.0, 0.0, 0.7]])
    for azimuth, elevation in ((10.0, 0.0), (0.0, 8.0), (-15.0, 5.0)):
        offset = orbit_offset(azimuth, elevation, 0.7)
        assert float((offset[:3, 3] - target[0]).norm()) == pytest.approx(0.7, abs=1e-6)
        seen = transform_points(invert_se3(offset), target)
        torch.testing.assert_close(seen, target, atol=1e-6, rtol=0)


def test_positive_azimuth_is_right_and_positive_elevation_up() -> None:
    right = orbit_offset(90.0, 0.0, 2.0)[:3, 3]
    torch.testing.assert_close(right, torch.tensor([2.0, 0.0, 2.0]), atol=1e-6, rtol=0)
    up = orbit_offset(0.0, 30.0, 2.0)[:3, 3]
    torch.testing.assert_close(up, torch.tensor([0.0, -1.0, 2 - math.sqrt(3)]), atol=1e-6, rtol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_draw_is_a_function_of_seed_episode_variant_and_attempt(kind: type[PerturbationConfig]) -> None:
    config = kind()
    first = draw(config, 0, 1, 2, FRAMES)
    assert torch.equal(first, draw(config, 0, 1, 2, FRAMES))
    for key in ((1, 1, 2, FRAMES), (0, 2, 2, FRAMES), (0, 1, 3, FRAMES), (0, 1, 2, FRAMES, 1)):
        assert not torch.equal(first, draw(config, *key))


@pytest.mark.parametrize("variants", [2, 4, 8])
def test_variants_are_spread_over_the_range(variants: int) -> None:
    found = torch.cat([draw(OrbitConfig(), 3, 7, variant, FRAMES) for variant in range(variants)])
    strata = ((found + 1) / 2 * variants).floor()
    for column in strata.T:
        assert sorted(column.tolist()) == list(range(variants))


def test_with_per_frame_every_frame_has_its_own_draw() -> None:
    assert len(draw(OrbitConfig(), 0, 0, 0, FRAMES)) == 1
    rows = draw(OrbitConfig(per_frame=True), 0, 0, 0, FRAMES)
    assert len(rows.unique(dim=0)) == FRAMES


@pytest.mark.parametrize(
    ("config", "bounds"),
    [
        (OrbitConfig(azimuth_deg=4.0, elevation_deg=2.0, translation_m=0.1), [4, 2, 0.1, 0.1, 0.1, 0, 0, 0, 0]),
        (TranslationConfig(translation_m=0.1), [0, 0, 0.1, 0.1, 0.1, 0, 0, 0, 0]),
        (RotationConfig(pan_deg=1.0, tilt_deg=2.0, roll_deg=3.0), [0, 0, 0, 0, 0, 2, 1, 3, 0]),
        (DollyConfig(translation_m=0.1), [0, 0, 0, 0, 0.1, 0, 0, 0, 0]),
        (FocalConfig(zoom=0.2), [0, 0, 0, 0, 0, 0, 0, 0, math.log(1.2)]),
        (DriftConfig(azimuth_deg=4.0, elevation_deg=2.0, translation_m=0.1), [4, 2, 0.1, 0.1, 0.1, 0, 0, 0, 0]),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_is_drawn_lies_in_the_range(config: PerturbationConfig, bounds: list[float]) -> None:
    found = torch.cat([amounts(config, variant) for variant in range(32)]).abs().amax(0)
    assert (found <= torch.tensor(bounds) + 1e-6).all()
    assert (found >= 0.8 * torch.tensor(bounds)).all()


def test_shifts_are_metres_where_these_are_true_and_else_shares_of_the_distance() -> None:
    config = TranslationConfig(translation_m=0.1, translation_rel=0.5)
    ratio = amounts(config, metric=False)[0, 2:5] / amounts(config)[0, 2:5]
    torch.testing.assert_close(ratio, torch.full((3,), 0.5 * DISTANCE / 0.1))
    assert set(described(amounts(config), viewpoint())) == {"shift_x_m", "shift_y_m", "shift_z_m"}
    rel = described(amounts(config, metric=False), viewpoint(metric=False))
    assert abs(rel["shift_x_rel"]) <= 0.5


def test_drift_is_smooth() -> None:
    config = DriftConfig(azimuth_deg=6.0, cycles=0.5)
    azimuth = amounts_of(config, draw(config, 0, 0, 0, 100), viewpoint(), 0)[:, 0]
    assert float(azimuth.diff().abs().max()) < 0.5
    assert float(azimuth.max() - azimuth.min()) > 0.1


def test_a_given_pose_is_reached_and_half_of_it_is_half_way() -> None:
    pose = invert_se3(orbit_offset(20.0, 5.0, DISTANCE))
    config = PosesConfig(poses=[pose[:3].flatten().tolist()])
    found = amounts(config)
    view = {"a": viewpoint()}
    whole = moved(config, view, {"a": found})["a"].camera_from_world[0]
    torch.testing.assert_close(whole, pose, atol=1e-5, rtol=0)
    half = moved(config, view, {"a": 0.5 * found})["a"].world_from_camera[0]
    torch.testing.assert_close(half[:3, 3], 0.5 * invert_se3(pose)[:3, 3], atol=1e-5, rtol=0)


def test_another_cameras_pose() -> None:
    other = orbit_offset(25.0, -5.0, DISTANCE)
    view = viewpoint(orbit_offset(-10.0, 0.0, DISTANCE), origin="calibration")
    config = OtherCameraConfig(camera="side")
    found = moved(config, {"a": view}, {"a": amounts_of(config, torch.zeros(1, 9), view, 0, other)})["a"]
    torch.testing.assert_close(found.world_from_camera[2], other, atol=1e-5, rtol=0)


def test_a_longer_focal_length_keeps_the_principal_point() -> None:
    view = viewpoint()
    change = torch.zeros(1, len(AMOUNTS))
    change[0, -1] = math.log(1.5)
    found = moved(FocalConfig(), {"a": view}, {"a": change})["a"].intrinsics[0]
    torch.testing.assert_close(found[:2, :2], 1.5 * view.camera.intrinsics[0, :2, :2])
    assert torch.equal(found[:, 2], view.camera.intrinsics[0, :, 2])


def test_calibrated_cameras_move_as_one_body_others_each_by_itself() -> None:
    poses = [orbit_offset(0.0, 0.0, DISTANCE), orbit_offset(40.0, 10.0, DISTANCE)]
    config = OrbitConfig()
    for origin, rigid in (("calibration", True), ("assumed", False)):
        views = {str(i): viewpoint(pose, origin=origin) for i, pose in enumerate(poses)}
        found = moved(config, views, {key: amounts(config) for key in views})
        a, b = (found[key].world_from_camera[0] for key in "01")
        between, before = invert_se3(a) @ b, invert_se3(poses[0]) @ poses[1]
        assert torch.allclose(between, before, atol=1e-5) == rigid
        torch.testing.assert_close(a, poses[0] @ offsets(amounts(config), DISTANCE)[0])


def test_nothing_allowed_means_nothing_changes() -> None:
    for config in (OrbitConfig(azimuth_deg=0.0, elevation_deg=0.0, translation_m=0.0), FocalConfig(zoom=0.0)):
        view = {"a": viewpoint()}
        found = moved(config, view, {"a": amounts(config)})["a"]
        torch.testing.assert_close(found.world_from_camera, view["a"].camera.world_from_camera)
        torch.testing.assert_close(found.intrinsics, view["a"].camera.intrinsics)


def test_unknown_kind_is_refused() -> None:
    with pytest.raises(ConfigError, match="PerturbationConfig"):
        amounts(PerturbationConfig())


def test_look_at_distance_is_that_of_the_middle() -> None:
    depth = torch.full((8, 8), 5.0)
    depth[2:6, 2:6] = 0.7
    depth[3, 3] = 0
    assert look_at_distance(depth) == pytest.approx(0.7)
    assert look_at_distance(torch.zeros(8, 8)) == 1.0


def test_the_summary_says_in_which_unit_cameras_were_shifted() -> None:
    metres = described(amounts(OrbitConfig()), viewpoint())
    drawn = [
        {"front": metres, "side": metres},
        {"top": described(amounts(OrbitConfig(), metric=False), viewpoint(metric=False))},
    ]
    said = "metres (front, side) and shares of the look-at distance, as depth has no true scale (top)"
    assert units_of_shifts(drawn) == f"shifts are {said}\n"
    assert units_of_shifts(drawn[:1]) == "shifts are metres (front, side)\n"
    assert units_of_shifts([{}, {"front": described(amounts(RotationConfig()), viewpoint())}]) == ""
