"""All levels of motion, from tracks: what is kept, how well it predicts, and odd input."""

import dataclasses

import pytest
import torch
from motion_levels import of_bases
from torch import Tensor

from lerobot_msdyn.core.cameras import static_camera
from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.motion.estimate import motion_from_tracks, near_canonical, scene_motion
from lerobot_msdyn.motion.from_tracks.lift import LiftedTracks
from lerobot_msdyn.motion.model.scene_motion import SceneMotion
from lerobot_msdyn.priors import PointTracks
from lerobot_msdyn.synthetic.bodies import TrackedBody, tracked_body

pytestmark = pytest.mark.slow

K = torch.tensor([[100.0, 0.0, 32.0], [0.0, 100.0, 24.0], [0.0, 0.0, 1.0]])


def lifted(xyz: Tensor, valid: Tensor | None = None, instance: Tensor | None = None) -> LiftedTracks:
    valid = torch.ones(xyz.shape[:2], dtype=torch.bool) if valid is None else valid
    instance = torch.ones(len(xyz), dtype=torch.long) if instance is None else instance
    return LiftedTracks(xyz, valid, valid.float(), instance, pixel_m=0.002)


def fitted(body: TrackedBody, *levels: str, gate: bool = True) -> SceneMotion:
    return motion_from_tracks(lifted(body.seen, body.valid), MotionConfig(levels=list(levels), max_parts=1, gate=gate))


def error_mm(motion: SceneMotion, body: TrackedBody) -> float:
    """Mean distance from the truth of the true canonical points, carried to every frame."""
    frames = torch.arange(body.truth.shape[1])
    moved, _ = motion.moved(body.truth[:, motion.canonical_frame], motion.part, frames)
    return float(1000 * (moved.transpose(0, 1) - body.truth).norm(dim=-1).mean())


@pytest.fixture(scope="module")
def deformable() -> TrackedBody:
    return tracked_body("deformable")


@pytest.fixture(scope="module")
def by_levels(deformable: TrackedBody) -> dict[str, SceneMotion]:
    """The motion down to each level: a level is built on the coarser ones and leaves them as they are."""
    whole = fitted(deformable, "object", "primitive", "grain", "particle")
    return {
        name: dataclasses.replace(whole, names=whole.names[: i + 1], levels=whole.levels[: i + 1])
        for i, name in enumerate(whole.names)
    }


def test_each_level_explains_more_of_a_deformation(deformable, by_levels) -> None:
    object_, primitive, grain = (error_mm(by_levels[name], deformable) for name in by_levels)
    assert object_ > 1.5 * primitive
    assert primitive > 1.2 * grain
    assert grain < 1.3
    assert "particle" not in by_levels  # explains nothing that is left, and is refused


def test_the_gate_keeps_what_proves_itself(by_levels) -> None:
    motion = by_levels["grain"]
    assert [bool(level.active.any()) for level in motion.levels] == [True, True, True]
    assert len(motion.levels[1]) == 5
    assert len(motion.levels[2]) == 5 * 10 + 1  # and the idle one


def test_a_rigid_body_gets_no_finer_levels() -> None:
    body = tracked_body("rigid")
    motion = fitted(body, "object", "primitive", "grain")
    assert motion.names == ("object",)
    assert error_mm(motion, body) < 0.3
    assert error_mm(fitted(body, "object", "primitive", "grain", gate=False), body) > error_mm(motion, body)


def test_nothing_moves_at_the_canonical_frame(by_levels) -> None:
    motion = by_levels["grain"]
    moved, turn = motion.moved(motion.points, motion.part, torch.tensor([motion.canonical_frame]))
    torch.testing.assert_close(moved[0], motion.points, atol=1e-5, rtol=0)
    torch.testing.assert_close(turn[0, :, 0].abs(), torch.ones(len(motion.points)), atol=1e-5, rtol=0)


def test_points_seen_in_any_frame_find_their_way_back(deformable, by_levels) -> None:
    motion = by_levels["grain"]
    for frame in (0, 59):
        at = torch.tensor([frame])
        points, part = motion.to_canonical(deformable.truth[:, frame], frame, torch.ones(3000, dtype=torch.long))
        again, _ = motion.moved(points, part, at)
        assert (again[0] - deformable.truth[:, frame]).norm(dim=-1).quantile(0.99) < 1e-4
        canonical = deformable.truth[:, motion.canonical_frame]
        assert (points - canonical).norm(dim=-1).mean() < 3e-3


def test_objects_in_contact_keep_to_their_own(tumbling, late) -> None:
    """Two bodies that touch at first: the mask tells them apart, not the distance."""
    beside = tumbling.xyz[:, 0].mean(0) - late.xyz[:, 0].mean(0) + torch.tensor([0.04, 0.0, 0.0])
    xyz = torch.cat((tumbling.xyz, late.xyz + beside))
    instance = torch.tensor([1] * 60 + [2] * 60)
    motion = motion_from_tracks(lifted(xyz, instance=instance), MotionConfig(max_parts=1))
    frames = torch.arange(24)
    for label in (1, 2):
        mine = instance == label
        points, part = motion.to_canonical(xyz[mine, 7], 7, instance[mine])
        moved, _ = motion.moved(points, part, frames)
        assert (moved.transpose(0, 1) - xyz[mine]).norm(dim=-1).max() < 1e-3


def test_late_arrivals_leavers_and_gaps(tumbling, late) -> None:
    xyz = torch.cat((tumbling.xyz, late.xyz))
    valid = torch.ones(120, 24, dtype=torch.bool)
    valid[:60, 16:] = False  # leaves
    valid[60:, :6] = False  # appears late
    valid[60:90, 10:14] = False  # a gap
    motion = motion_from_tracks(lifted(xyz, valid, torch.tensor([1] * 60 + [2] * 60)), MotionConfig())
    moved, _ = motion.moved(motion.points, motion.part, torch.arange(24))
    error = (moved.transpose(0, 1) - xyz).norm(dim=-1)
    assert error[valid].max() < 1e-3
    assert error[60:90, 10:14].max() < 1e-3
    torch.testing.assert_close(moved[16:, :60], moved[15, :60].expand(8, 60, 3))  # held


def test_nothing_moves(resting) -> None:
    xyz = resting.xyz + 2e-4 * torch.randn(60, 24, 3, generator=torch.Generator().manual_seed(0))
    motion = motion_from_tracks(lifted(xyz), MotionConfig())
    assert not any(bool(level.active.any()) for level in of_bases(motion.levels))


def test_one_track_is_enough() -> None:
    motion = motion_from_tracks(lifted(torch.zeros(1, 5, 3)), MotionConfig())
    moved, _ = motion.moved(motion.points, motion.part, torch.arange(5))
    assert torch.isfinite(moved).all()


def test_from_the_image_to_the_motion() -> None:
    """A square that slides by 1 px a frame at 2 m from a camera of 100 px focal length: 2 cm a frame."""
    frames = 12
    x, y = torch.meshgrid(torch.arange(10.0, 22, 2), torch.arange(16.0, 28, 2), indexing="xy")
    xy = torch.stack((x, y), dim=-1).reshape(-1, 1, 2) + torch.arange(frames)[:, None] * torch.tensor([1.0, 0.0])
    n = len(xy)
    tracks = PointTracks(
        xy, torch.ones(n, frames, dtype=torch.bool), torch.ones(n, frames), torch.ones(n, dtype=torch.long)
    )
    motion = scene_motion(
        tracks, torch.full((frames, 48, 64), 2.0), static_camera(K, frames, 64, 48), MotionConfig(levels=["object"])
    )
    assert motion is not None
    (level,) = of_bases(motion.levels)
    assert len(level) == 1
    shift = (torch.arange(frames) - motion.canonical_frame)[:, None] * torch.tensor([0.02, 0.0, 0.0])
    torch.testing.assert_close(level.displacements[0], shift, atol=1e-5, rtol=0)


def test_without_usable_tracks_there_is_no_motion() -> None:
    frames = 4
    seen = torch.ones(3, frames)
    tracks = PointTracks(torch.full((3, frames, 2), 10.0), seen > 0, seen, torch.ones(3, dtype=torch.long))
    camera = static_camera(torch.eye(3), frames, 64, 48)
    assert scene_motion(tracks, torch.zeros(frames, 48, 64), camera, MotionConfig()) is None


def test_canonical_points_are_averaged_where_the_track_was_seen_nearest() -> None:
    positions = torch.arange(6.0)[None, :, None].expand(2, 6, 3)
    weights = torch.tensor([[1.0, 1, 1, 0, 0, 0], [0, 0, 0, 0, 1, 0]])
    found = near_canonical(positions, weights, 1)
    torch.testing.assert_close(found[:, 0], torch.tensor([1.0, 4.0]))
