"""Parts by what the video shows: points go where they belong, parts are split and given up."""

from collections.abc import Callable
from dataclasses import replace

import torch

from lerobot_msdyn.motion.to_video.alignment import Sightings, Video
from lerobot_msdyn.motion.to_video.regroup import Grouping, regroup


def whole(truth: Grouping, points: Sightings) -> Grouping:
    """Every instance one part, with the motion of one of its bodies."""
    labels, instance = points.instance.unique(return_inverse=True)
    rows = torch.tensor([int((truth.instance == label).nonzero()[0, 0]) for label in labels])
    return replace(truth.select(rows), part=instance)


def test_what_moves_apart_is_split(
    video: Video, points: Sightings, truth: Grouping, cost: Callable[[Grouping], float]
) -> None:
    start = whole(truth, points)
    found = regroup(video, points, start, 6)
    assert len(found.motions) > len(start.motions)
    assert cost(found) < 0.8 * cost(start)


def test_copies_of_a_part_are_given_up(
    video: Video, points: Sightings, truth: Grouping, cost: Callable[[Grouping], float]
) -> None:
    twice = torch.arange(len(truth.motions)).repeat(2)
    part = truth.part + len(truth.motions) * (torch.arange(len(truth.part)) % 2)
    found = regroup(video, points, replace(truth.select(twice), part=part), 6)
    assert len(found.motions) <= len(truth.motions) + 1
    assert cost(found) < 1.1 * cost(truth)


def test_an_instance_has_no_more_parts_than_allowed(video: Video, points: Sightings, truth: Grouping) -> None:
    found = regroup(video, points, truth, 1)
    assert len(found.motions) == len(truth.instance.unique())
    assert bool((found.instance[found.part] == points.instance).all())


def test_known_parts_stay_as_they_are(video: Video, points: Sightings, truth: Grouping) -> None:
    known = int(truth.instance[0])
    off = truth.motions.clone()
    off[truth.instance == known, 3, 0, 3] += 0.02
    found = regroup(video, points, replace(truth, motions=off, tracked=off), 1, known)
    kept = found.instance == known
    assert torch.equal(found.motions[kept], off[truth.instance == known])
