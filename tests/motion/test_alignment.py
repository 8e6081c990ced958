"""The video against points and motions: true motions cost least, alignment finds back to them."""

from collections.abc import Callable
from dataclasses import replace

import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.motion.to_video.alignment import Sightings, Video, align, read_video
from lerobot_msdyn.motion.to_video.regroup import Grouping


def shifted(truth: Grouping, video: Video) -> Grouping:
    """Every third frame some pixels off."""
    motions = truth.motions.clone()
    motions[:, 1::3, :3, 3] += 1.5 * video.pixel_m
    return replace(truth, motions=motions)


def test_true_motions_cost_least(
    video: Video, points: Sightings, truth: Grouping, cost: Callable[[Grouping], float]
) -> None:
    assert cost(truth) < 0.9 * cost(shifted(truth, video))


def test_alignment_takes_out_most_of_a_small_shift(
    video: Video, points: Sightings, truth: Grouping, cost: Callable[[Grouping], float]
) -> None:
    off = shifted(truth, video)
    found = off
    for _ in range(3):
        motions = align(video, points, truth.part, found.motions, off.motions)
        found = replace(off, motions=motions)
    best, worst = cost(truth), cost(off)
    assert cost(found) - best < 0.5 * (worst - best)


def test_sightings_lie_on_what_moves(video: Video, points: Sightings) -> None:
    assert bool((points.instance > 0).all())
    away = points.xyz - video.camera.world_from_camera[points.frame, :3, 3]
    assert bool(((away * points.normals).sum(-1) < 0).all())
    torch.testing.assert_close(points.normals.norm(dim=-1), torch.ones(len(points)))


def test_without_any_mask_all_is_as_far_outside_as_can_be() -> None:
    camera = static_camera(intrinsics_from_fov(48, 36, 60.0), 1, 48, 36)
    nothing = torch.zeros(1, 36, 48, dtype=torch.uint8)
    video = read_video(torch.zeros(1, 36, 48, 3, dtype=torch.uint8), torch.ones(1, 36, 48), nothing, camera, 0.002)
    assert (video.maps.outside >= 254).all()
