"""The contact sheet: what is shown where."""

import numpy as np
import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.observations import DepthTraits, View
from lerobot_msdyn.priors import PointTracks, Priors
from lerobot_msdyn.priors.sheet import PALETTE, coloured_depth, contact_sheet, depth_range


def priors_of(view: View, depth: torch.Tensor) -> Priors:
    """One instance with one track that is lost halfway."""
    frames, height, width = view.rgb.shape[:3]
    instances = torch.zeros(frames, height, width, dtype=torch.uint8)
    instances[:, 10:20, 10:20] = 1
    visible = torch.arange(frames)[None] < frames // 2
    tracks = PointTracks(torch.full((1, frames, 2), 15.0), visible, visible.float(), torch.ones(1, dtype=torch.int64))
    return Priors(depth, instances, tracks, DepthTraits(metric=True), {"masks": {"provider": "change"}})


def test_every_camera_has_four_rows_of_pictures(sliding) -> None:
    view = View(sliding.rgb, static_camera(intrinsics_from_fov(96, 72, 60.0), len(sliding.rgb), 96, 72))
    priors = priors_of(view, torch.ones(view.rgb.shape[:3]))
    one = contact_sheet([("a", view, priors)], 30, 4)
    two = contact_sheet([("a", view, priors), ("b", view, priors)], 30, 4)
    assert one.shape[1] == 4 * 324
    assert two.shape == (2 * one.shape[0], one.shape[1], 3)
    assert (one == PALETTE[0]).all(-1).sum() > 50, "outlines are in the instance's colour"


def test_a_clip_shorter_than_the_columns_shows_each_frame_once(sliding) -> None:
    view = View(sliding.rgb[:2], static_camera(intrinsics_from_fov(96, 72, 60.0), 2, 96, 72))
    assert contact_sheet([("a", view, priors_of(view, torch.zeros(2, 72, 96)))], 30, 6).shape[1] == 2 * 324


def test_near_is_red_far_is_blue_unknown_is_grey() -> None:
    depth = np.array([[0.5, 2.0, 0.0]], np.float32)
    near, far, unknown = coloured_depth(depth, 0.5, 2.0)[0].astype(int)
    assert near[0] > near[2]
    assert far[2] > far[0]
    assert unknown.tolist() == [90, 90, 90]


def test_the_colours_span_the_known_depths(sliding) -> None:
    view = View(sliding.rgb[:2], static_camera(intrinsics_from_fov(96, 72, 60.0), 2, 96, 72))
    depth = torch.linspace(1, 3, 2 * 72 * 96).reshape(2, 72, 96)
    depth[0, :10] = 0
    near, far = depth_range(priors_of(view, depth))
    assert 1.0 < near < 1.4
    assert 2.9 < far < 3.0
