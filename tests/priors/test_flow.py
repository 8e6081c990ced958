"""Point tracks by optical flow."""

import cv2
import numpy as np
import torch

from lerobot_msdyn.priors.tracks.flow import flow_tracks


def errors(tracks, corner: np.ndarray) -> torch.Tensor:
    """Distance (px) between visible positions and where the block has carried them from their first sight."""
    first = tracks.visible.float().argmax(1)
    offset = torch.from_numpy(corner).float() - torch.from_numpy(corner).float()[first][:, None]
    start = tracks.xy[torch.arange(len(tracks)), first]
    return (tracks.xy - (start[:, None] + offset)).norm(dim=-1)[tracks.visible]


def test_tracks_follow_the_block(sliding) -> None:
    tracks = flow_tracks(sliding.rgb, sliding.mask.to(torch.uint8))
    assert len(tracks) > 40
    assert (tracks.instance == 1).all()
    assert tracks.visible.float().mean() > 0.8
    error = errors(tracks, sliding.corner)
    assert error.median() < 0.15
    assert error.quantile(0.95) < 0.6
    assert ((tracks.confidence > 0) == tracks.visible).all()
    assert tracks.confidence.max() <= 1


def test_points_come_back_in_pixels_of_the_video(sliding) -> None:
    """Twice as wide a video, tracked at its original width."""
    large = np.stack([cv2.resize(f, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR) for f in sliding.rgb.numpy()])
    mask = sliding.mask.repeat_interleave(2, dim=1).repeat_interleave(2, dim=2).to(torch.uint8)
    tracks = flow_tracks(torch.from_numpy(large), mask, max_width=96)
    assert errors(tracks, 2 * sliding.corner).median() < 0.3


def test_a_covered_point_is_not_visible_and_comes_back(sliding) -> None:
    rgb, mask = sliding.rgb.clone(), sliding.mask.to(torch.uint8)
    rgb[2:5, 20:60, 5:20] = 128  # something grey stands before the left third of the resting block
    tracks = flow_tracks(rgb, mask)
    covered = tracks.xy[:, 3, 0] < 17
    assert covered.sum() >= 5
    assert not tracks.visible[covered, 3].any()
    long = tracks.visible[:, 1] & (tracks.xy[:, 1, 0] < 17)
    assert long.sum() >= 5
    assert tracks.visible[long, 7].float().mean() > 0.6


def test_new_points_start_on_what_appears_later(sliding) -> None:
    mask = sliding.mask.to(torch.uint8)
    mask[:12] = 0
    tracks = flow_tracks(sliding.rgb, mask)
    assert len(tracks) > 20
    assert not tracks.visible[:, :12].any()
    assert tracks.visible[:, 20].any()


def test_each_instance_keeps_its_points(sliding) -> None:
    mask = sliding.mask.to(torch.uint8)
    left = torch.arange(96) < 24
    mask[:8][:, :, left] *= 2
    tracks = flow_tracks(sliding.rgb[:8], mask[:8])
    assert tracks.instance.unique().tolist() == [1, 2]
    assert (tracks.xy[tracks.instance == 2, 0, 0] < 24.5).all()


def test_nothing_to_follow(sliding) -> None:
    tracks = flow_tracks(sliding.rgb, torch.zeros_like(sliding.mask, dtype=torch.uint8))
    assert len(tracks) == 0
    assert tracks.xy.shape == (0, 30, 2)


def test_a_single_frame_has_no_tracks(sliding) -> None:
    tracks = flow_tracks(sliding.rgb[:1], sliding.mask[:1].to(torch.uint8))
    assert tracks.visible.shape == (0, 1)
