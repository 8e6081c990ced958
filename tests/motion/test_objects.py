"""The object level, from tracks."""

import torch
from torch import Tensor

from lerobot_msdyn.motion.from_tracks.objects import canonical_frame, initialise_objects
from lerobot_msdyn.motion.model.bases import level_affines


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


def test_what_hardly_moves_does_not_move(tumbling, resting) -> None:
    xyz = torch.cat((tumbling.xyz, resting.xyz))
    xyz = xyz + 5e-4 * torch.randn(xyz.shape, generator=torch.Generator().manual_seed(0))
    part = torch.arange(2).repeat_interleave(60)
    seen = torch.ones(xyz.shape[:2])
    level, _ = initialise_objects(xyz, seen > 0, seen, part, 0, still_m=1e-3)
    assert level.active.tolist() == [True, False]
    torch.testing.assert_close(level_affines(level, torch.tensor([20]))[1, 0], torch.eye(3, 4))
