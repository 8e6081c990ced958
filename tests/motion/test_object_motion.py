"""The object level, from tracks."""

import torch
from torch import Tensor

from lerobot_msdyn.cameras import static_camera
from lerobot_msdyn.motion.bases import level_affines
from lerobot_msdyn.motion.initialise import ObjectMotion, canonical_frame, initialise_objects, object_motion
from lerobot_msdyn.priors import PointTracks


def moved(level, part: int, points: Tensor) -> Tensor:
    """Canonical points [n,3] carried by one basis to every frame [t,n,3]."""
    affine = level_affines(level, torch.arange(level.displacements.shape[1]))[part]
    return points @ affine[:, :, :3].transpose(1, 2) + affine[:, None, :, 3]


def fit(bodies: list, canonical: int, valid: Tensor | None = None):
    xyz = torch.cat([body.xyz for body in bodies])
    part = torch.arange(len(bodies)).repeat_interleave(60)
    everywhere = torch.ones(xyz.shape[:2], dtype=torch.bool) if valid is None else valid
    return initialise_objects(xyz, everywhere, torch.ones(xyz.shape[:2]), part, canonical)


def test_identity_at_the_canonical_frame(tumbling, late) -> None:
    level, points = fit([tumbling, late], 17)
    at = level_affines(level, torch.tensor([17]))[:, 0]
    torch.testing.assert_close(at, torch.eye(3, 4).expand(2, 3, 4), atol=1e-6, rtol=0)
    torch.testing.assert_close(points[:60], tumbling.xyz[:, 17], atol=1e-5, rtol=0)


def test_every_frame_is_reached(tumbling, late, resting) -> None:
    level, points = fit([tumbling, late, resting], 3)
    for part, body in enumerate((tumbling, late, resting)):
        error = moved(level, part, points[60 * part : 60 * part + 60]) - body.xyz.transpose(0, 1)
        assert error.norm(dim=-1).max() < 1e-5
    assert level.displacements[2].abs().max() < 1e-6


def test_the_worlds_origin_does_not_matter(tumbling) -> None:
    near, _ = fit([tumbling], 5)
    tumbling.points += 10.0
    rotation = tumbling.motions[:, :3, :3]
    tumbling.motions[:, :3, 3] += 10.0 - (rotation @ torch.full((3,), 10.0))
    far, _ = fit([tumbling], 5)
    torch.testing.assert_close(far.rotations_6d, near.rotations_6d, atol=1e-4, rtol=0)
    torch.testing.assert_close(far.displacements, near.displacements, atol=1e-5, rtol=0)


def test_a_body_that_is_lost_is_held(tumbling, resting) -> None:
    valid = torch.ones(120, 24, dtype=torch.bool)
    valid[:60, 15:] = False
    level, points = fit([tumbling, resting], 0, valid)
    carried = moved(level, 0, points[:60])
    torch.testing.assert_close(carried[14], tumbling.xyz[:, 14], atol=1e-5, rtol=0)
    torch.testing.assert_close(carried[15:], carried[14].expand(9, -1, -1), atol=1e-6, rtol=0)


def test_a_part_with_too_few_tracks_stands_still(tumbling) -> None:
    part = torch.tensor([0] * 57 + [1] * 3)
    level, points = initialise_objects(tumbling.xyz, torch.ones(60, 24, dtype=torch.bool), torch.ones(60, 24), part, 0)
    assert (level.displacements[1] == 0).all()
    torch.testing.assert_close(points[57:], tumbling.xyz[57:].mean(1))


def test_the_canonical_frame_sacrifices_no_instance() -> None:
    valid = torch.zeros(12, 5, dtype=torch.bool)
    valid[:10, 0] = True  # all of the large instance, nothing of the small one
    valid[:8, 2], valid[10:, 2] = True, True
    valid[:6, 3], valid[10:, 3] = True, True
    assert canonical_frame(valid, torch.tensor([1] * 10 + [2] * 2)) == 2


def test_ties_go_to_the_middle_of_the_clip() -> None:
    assert canonical_frame(torch.ones(4, 9, dtype=torch.bool), torch.ones(4, dtype=torch.long)) == 4


def test_points_find_the_part_they_belong_to(tumbling, late) -> None:
    level, points = fit([tumbling, late], 0)
    motion = ObjectMotion(level, 0, points, torch.arange(2).repeat_interleave(60), torch.tensor([1] * 60 + [2] * 60))
    at = torch.cat((tumbling.xyz[:7, 20], late.xyz[:5, 20])) + 0.001
    unknown = torch.full((12,), 9)  # an instance without tracks: the nearest of any
    assert motion.assign(at, 20, unknown).tolist() == [0] * 7 + [1] * 5
    # the mask knows better than the distance
    assert motion.assign(tumbling.xyz[:7, 20], 20, torch.full((7,), 2)).tolist() == [1] * 7
    assert motion.assign(torch.zeros(0, 3), 20, torch.zeros(0, dtype=torch.long)).shape == (0,)


def test_from_the_image_to_the_motion() -> None:
    """A square that slides by 1 px a frame at 2 m from a camera of 100 px focal length: 2 cm a frame."""
    frames = 12
    x, y = torch.meshgrid(torch.arange(10.0, 22, 2), torch.arange(16.0, 28, 2), indexing="xy")
    xy = torch.stack((x, y), dim=-1).reshape(-1, 1, 2) + torch.arange(frames)[:, None] * torch.tensor([1.0, 0.0])
    n = len(xy)
    tracks = PointTracks(
        xy, torch.ones(n, frames, dtype=torch.bool), torch.ones(n, frames), torch.ones(n, dtype=torch.long)
    )
    K = torch.tensor([[100.0, 0.0, 32.0], [0.0, 100.0, 24.0], [0.0, 0.0, 1.0]])
    result = object_motion(tracks, torch.full((frames, 48, 64), 2.0), static_camera(K, frames, 64, 48), 4)
    assert result is not None
    assert len(result.level) == 1
    shift = (torch.arange(frames) - result.canonical_frame)[:, None] * torch.tensor([0.02, 0.0, 0.0])
    torch.testing.assert_close(result.level.displacements[0], shift, atol=1e-5, rtol=0)


def test_without_usable_tracks_there_is_no_motion() -> None:
    frames = 4
    tracks = PointTracks(
        torch.full((3, frames, 2), 10.0),
        torch.ones(3, frames, dtype=torch.bool),
        torch.ones(3, frames),
        torch.ones(3, dtype=torch.long),
    )
    camera = static_camera(torch.eye(3), frames, 64, 48)
    assert object_motion(tracks, torch.zeros(frames, 48, 64), camera, 4) is None
