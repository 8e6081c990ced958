"""Bodies whose motion is known are the object level of their instance."""

import torch

from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.geometry import transform_points
from lerobot_msdyn.core.observations import BodyTracks
from lerobot_msdyn.motion.estimate import motion_from_tracks
from lerobot_msdyn.motion.from_tracks.lift import LiftedTracks

FRAMES = 12


def turned(points: torch.Tensor, degrees: torch.Tensor, about: torch.Tensor) -> torch.Tensor:
    """Points [n, 3] turned about a vertical axis by an angle per frame, [n, t, 3]."""
    a = degrees.deg2rad()
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    rotation = torch.stack((a.cos(), -a.sin(), zero, a.sin(), a.cos(), zero, zero, zero, one), dim=1).unflatten(
        1, (3, 3)
    )
    pose = torch.eye(4).repeat(len(a), 1, 1)
    pose[:, :3, :3], pose[:, :3, 3] = rotation, about - (rotation @ about)
    return transform_points(pose, points.expand(len(a), -1, -1)).transpose(0, 1)


def test_links_move_as_is_known_whatever_their_tracks_say() -> None:
    torch.manual_seed(0)
    points = torch.rand(80, 3) * 0.1
    body = torch.arange(80) % 2
    angles = torch.linspace(0, 40, FRAMES)
    truth = torch.empty(80, FRAMES, 3)
    truth[body == 0] = turned(points[body == 0], angles, torch.zeros(3))
    truth[body == 1] = turned(points[body == 1], -2 * angles, torch.tensor([0.3, 0.0, 0.0]))
    visible = torch.rand(80, FRAMES) < 0.3
    visible[:, 5] = True
    wrong = torch.rand(30, 1, 3) + torch.rand(30, FRAMES, 3)
    box = torch.rand(20, 1, 3) * 0.05 + torch.linspace(0, 0.2, FRAMES)[:, None] * torch.tensor([1.0, 0.0, 0.0]) + 0.5
    instance = torch.cat((torch.full((30,), 3), torch.full((20,), 2)))
    seen = torch.ones(50, FRAMES, dtype=torch.bool)
    tracks = LiftedTracks(torch.cat((wrong, box)), seen, seen.float(), instance, pixel_m=0.002)
    motion = motion_from_tracks(
        tracks.followed_by(BodyTracks(truth, visible, body, instance=3)), MotionConfig(levels=["object"])
    )
    rows = motion.instance == 3
    assert int(rows.sum()) == 80
    assert len(motion.part[rows].unique()) == 2
    moved = motion.moved_points(truth[:, motion.canonical_frame], motion.part[rows], torch.arange(FRAMES))
    assert float((moved.transpose(0, 1) - truth).norm(dim=-1).max()) < 1e-3
    assert len(motion.part[~rows].unique()) == 1
