"""Which parts a point follows, and how strongly."""

import math

import torch

from lerobot_msdyn.motion.model.binding import OTHER_INSTANCE, nearest_parts

TRACKS = torch.tensor([[-2.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [0.0, 1.0, 0], [0.0, 2.0, 0]])
PARTS = torch.tensor([0, 0, 1, 1, 2, 2])
INSTANCES = torch.tensor([1, 1, 1, 1, 2, 2])


def bound(point: list[float], part: int, count: int, reach: float = 2.0) -> tuple[list[int], list[float]]:
    index, logit = nearest_parts(torch.tensor([point]), torch.tensor([part]), TRACKS, PARTS, INSTANCES, count, reach)
    return index[0].tolist(), logit[0].tolist()


def test_the_own_part_comes_first_and_the_nearest_other_one_by_its_distance() -> None:
    index, logit = bound([0.0, 0, 0], 0, 2)  # parts are 0.5 in size: s is 1
    assert index == [0, 1]
    assert logit[0] == 0
    assert math.isclose(logit[1], -0.5, rel_tol=1e-5)


def test_parts_of_another_instance_count_less() -> None:
    index, logit = bound([0.0, 0, 0], 0, 3)
    assert index == [0, 1, 2]
    assert math.isclose(logit[2], -0.5 + OTHER_INSTANCE, rel_tol=1e-5)


def test_what_is_far_has_no_weight_and_one_part_is_the_own_alone() -> None:
    assert bound([-2.0, 0, 0], 0, 2, reach=0.01)[1][1] < -20
    assert bound([0.0, 0, 0], 1, 1) == ([1], [0.0])
    assert len(bound([0.0, 0, 0], 1, 9)[0]) == 3
