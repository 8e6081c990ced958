"""Lifting of tracks to the world."""

import torch

from lerobot_msdyn.core.cameras import static_camera
from lerobot_msdyn.motion.from_tracks.lift import lift_tracks, position_noise
from lerobot_msdyn.priors import PointTracks

K = torch.tensor([[100.0, 0.0, 32.0], [0.0, 100.0, 24.0], [0.0, 0.0, 1.0]])


def tracks_at(xy: list[tuple[float, float]], frames: int) -> PointTracks:
    """Points that stand still in the image."""
    n = len(xy)
    return PointTracks(
        torch.tensor(xy)[:, None].repeat(1, frames, 1),
        torch.ones(n, frames, dtype=torch.bool),
        torch.ones(n, frames),
        torch.ones(n, dtype=torch.long),
    )


def test_a_pixel_becomes_a_world_point() -> None:
    world_from_camera = torch.eye(4)
    world_from_camera[:3, 3] = torch.tensor([1.0, 0.0, -1.0])
    camera = static_camera(K, 6, 64, 48, world_from_camera)
    xyz, valid = lift_tracks(tracks_at([(42.0, 24.0)], 6), torch.full((6, 48, 64), 2.0), camera)
    assert valid.all()
    torch.testing.assert_close(xyz[0], torch.tensor([1.2, 0.0, 1.0]).expand(6, 3))


def test_depth_edges_and_unknown_depth_are_refused() -> None:
    depth = torch.full((6, 48, 320), 2.0)
    depth[:, :, 160:] = 1.0
    depth[:, 40:] = 0.0
    camera = static_camera(K, 6, 320, 48)
    # pixel columns 158..161 are within two pixels of the edge between columns 159 and 160
    points = [(157.5, 20.5), (158.5, 20.5), (161.5, 20.5), (162.5, 20.5), (10.5, 44.5), (10.5, 39.5)]
    _, valid = lift_tracks(tracks_at(points, 6), depth, camera)
    assert valid.all(1).tolist() == [True, False, False, True, False, True]


def test_a_depth_spike_is_smoothed_away() -> None:
    depth = torch.full((9, 48, 64), 1.0)
    depth[4] = 1.5
    xyz, valid = lift_tracks(tracks_at([(32.0, 24.0)], 9), depth, static_camera(K, 9, 64, 48))
    assert valid.all()
    torch.testing.assert_close(xyz[0, :, 2], torch.ones(9))


def test_the_shorter_side_of_a_teleport_is_dropped() -> None:
    tracks = tracks_at([(10.0 + 2 * i, 20.0) for i in range(12)], 10)
    tracks.xy[4, 7:, 1] += 15
    xyz, valid = lift_tracks(tracks, torch.ones(10, 48, 64), static_camera(K, 10, 64, 48))
    assert valid[4].tolist() == [True] * 7 + [False] * 3
    assert valid[[i for i in range(12) if i != 4]].all()
    assert (xyz[4, 7:] == 0).all()


def test_noise_is_measured_on_a_moving_body(tumbling) -> None:
    noisy = tumbling.xyz + 0.002 * torch.randn(60, 24, 3, generator=torch.Generator().manual_seed(0))
    valid = torch.ones(60, 24, dtype=torch.bool)
    assert abs(position_noise(noisy, valid) - 0.002) < 2e-4
    assert position_noise(noisy, torch.zeros_like(valid)) == 0


def test_no_tracks() -> None:
    xyz, valid = lift_tracks(empty(5), torch.ones(5, 48, 64), static_camera(K, 5, 64, 48))
    assert xyz.shape == (0, 5, 3)
    assert valid.shape == (0, 5)


def empty(frames: int) -> PointTracks:
    return PointTracks(
        torch.zeros(0, frames, 2),
        torch.zeros(0, frames, dtype=torch.bool),
        torch.zeros(0, frames),
        torch.zeros(0, dtype=torch.long),
    )
