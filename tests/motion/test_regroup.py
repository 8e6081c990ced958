"""Parts by what the video shows: points go where they belong, parts are split and given up."""

from dataclasses import replace

import pytest
import torch

from lerobot_msdyn.geometry import invert_se3
from lerobot_msdyn.motion.alignment import Sightings, Video, align, carried_costs, read_video, sight
from lerobot_msdyn.motion.regroup import Grouping, regroup
from lerobot_msdyn.synthetic import SyntheticScene, make_scene

FRAMES = 12


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return make_scene("push", 0, FRAMES, 160, 120)


@pytest.fixture(scope="module")
def video(scene: SyntheticScene) -> Video:
    view = scene.render(scene.camera)
    pixel_m = float(view.depth[view.instances > 0].median() / scene.camera.intrinsics[0, 0, 0])
    return read_video(view.rgb, view.depth, view.instances, scene.camera, pixel_m)


@pytest.fixture(scope="module")
def points(video: Video) -> Sightings:
    return sight(video, list(range(0, FRAMES, 2)), 300)


@pytest.fixture(scope="module")
def truth(scene: SyntheticScene, points: Sightings) -> Grouping:
    """Every body a part, and each point in the part of the nearest tracked point of its instance."""
    tracks = scene.tracks(1500)
    bodies, part = tracks.body.unique(return_inverse=True)
    own = torch.stack(
        [
            part[
                torch.where(
                    tracks.instance == points.instance[i],
                    (tracks.positions[:, points.frame[i]] - points.xyz[i]).norm(dim=-1),
                    torch.inf,
                ).argmin()
            ]
            for i in range(len(points))
        ]
    )
    instance = torch.zeros(len(bodies), dtype=torch.long)
    instance[part] = tracks.instance
    motions = scene.world_from_body[bodies].double()
    motions = motions @ invert_se3(motions[:, FRAMES // 2])[:, None]
    return Grouping(own, motions, motions, instance, torch.ones(len(bodies), dtype=torch.bool))


def cost(video: Video, points: Sightings, found: Grouping) -> float:
    costs = carried_costs(video, points, found.motions, torch.arange(FRAMES))
    return float(costs.gather(1, found.part[:, None]).mean())


def whole(truth: Grouping, points: Sightings) -> Grouping:
    """Every instance one part, with the motion of one of its bodies."""
    labels, instance = points.instance.unique(return_inverse=True)
    rows = torch.tensor([int((truth.instance == label).nonzero()[0, 0]) for label in labels])
    return replace(truth.select(rows), part=instance)


def shifted(truth: Grouping, video: Video) -> Grouping:
    """Every third frame some pixels off."""
    motions = truth.motions.clone()
    motions[:, 1::3, :3, 3] += 1.5 * video.pixel_m
    return replace(truth, motions=motions)


def test_true_motions_cost_least(video: Video, points: Sightings, truth: Grouping) -> None:
    assert cost(video, points, truth) < 0.9 * cost(video, points, shifted(truth, video))


def test_alignment_takes_out_most_of_a_small_shift(video: Video, points: Sightings, truth: Grouping) -> None:
    off = shifted(truth, video)
    nothing = torch.zeros(1, *off.motions.shape[:2])
    found = off
    for _ in range(3):
        motions = align(video, points, truth.part, found.motions, off.motions[None], nothing)
        found = replace(off, motions=motions)
    best, worst = cost(video, points, truth), cost(video, points, off)
    assert cost(video, points, found) - best < 0.5 * (worst - best)


def test_what_moves_apart_is_split(video: Video, points: Sightings, truth: Grouping) -> None:
    start = whole(truth, points)
    found = regroup(video, points, start, 6)
    assert len(found.motions) > len(start.motions)
    assert cost(video, points, found) < 0.8 * cost(video, points, start)


def test_copies_of_a_part_are_given_up(video: Video, points: Sightings, truth: Grouping) -> None:
    twice = torch.arange(len(truth.motions)).repeat(2)
    part = truth.part + len(truth.motions) * (torch.arange(len(truth.part)) % 2)
    found = regroup(video, points, replace(truth.select(twice), part=part), 6)
    assert len(found.motions) <= len(truth.motions) + 1
    assert cost(video, points, found) < 1.1 * cost(video, points, truth)


def test_an_instance_has_no_more_parts_than_allowed(video: Video, points: Sightings, truth: Grouping) -> None:
    found = regroup(video, points, truth, 1)
    assert len(found.motions) == len(truth.instance.unique())
    assert bool((found.instance[found.part] == points.instance).all())
