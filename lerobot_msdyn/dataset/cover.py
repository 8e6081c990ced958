"""Some episodes of a dataset that cover what is recorded in all of them: every task, and the ways it was done."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_STATE
from numpy import ndarray

from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.dataset.rows import read_columns

MOMENTS = 5  # of an episode, evenly from its first frame to its last, that stand for its course


def covering_episodes(source: LeRobotDatasetMetadata, episodes: Sequence[int], share: int | float) -> list[int]:
    """A share of some episodes, at least one, in order: those whose states and actions differ most from each other's.

    The same ones for the same recordings. Every task has its share, the first of each task before a second of any.
    Episodes whose states or actions cannot be read are not among them.

    Args:
        source: the dataset.
        episodes: those to choose from.
        share: above 0, at most 1, of the episodes.

    Raises:
        EpisodeError: none can be read; the first one's reason.
    """
    courses: dict[int, Float64[ndarray, " d"]] = {}
    errors = []
    for index in episodes:
        try:
            courses[index] = _course(source, index)
        except EpisodeError as error:
            errors.append(error)
    if not courses:
        raise errors[0]
    by_task: dict[tuple[str, ...], list[int]] = {}
    for index in courses:
        by_task.setdefault(tuple(source.episodes[index]["tasks"]), []).append(index)
    count = min(len(courses), max(1, round(share * len(episodes))))
    shares = shared_out(count, [len(members) for members in by_task.values()])
    scaled = dict(zip(courses, _scaled(np.stack(list(courses.values()))), strict=True))
    chosen: list[int] = []
    for members, most in zip(by_task.values(), shares, strict=True):
        places = farthest(np.stack([scaled[index] for index in members]), most)
        chosen += [members[place] for place in places]
    return sorted(chosen)


def farthest(points: Float64[ndarray, "n d"], count: int) -> list[int]:
    """So many of the points: the one nearest to their mean, then always the one that is farthest from those chosen."""
    distance = np.linalg.norm(points - points.mean(0), axis=1)
    chosen: list[int] = []
    for _ in range(count):
        place = int(distance.argmax() if chosen else distance.argmin())
        nearest = np.linalg.norm(points - points[place], axis=1)
        distance = np.minimum(distance, nearest) if chosen else nearest
        chosen.append(place)
        distance[chosen] = -1.0  # also where several points are alike
    return chosen


def shared_out(count: int, sizes: Sequence[int]) -> list[int]:
    """How many of `count` go to each of some groups: always the next to the one of which the least share has some."""
    given = [0] * len(sizes)
    for _ in range(count):
        group = min(range(len(sizes)), key=lambda i: (given[i] / sizes[i], i))
        given[group] += 1
    return given


def _course(source: LeRobotDatasetMetadata, index: int) -> Float64[ndarray, " d"]:
    """States and actions at a few moments of an episode, [MOMENTS * values].

    Raises:
        EpisodeError: they cannot be read, or are no numbers.
    """
    columns = read_columns(source, index, [key for key in (OBS_STATE, ACTION) if key in source.features])
    values = np.concatenate([column.reshape(len(column), -1) for column in columns.values()], axis=1)
    moments = np.linspace(0, len(values) - 1, MOMENTS).round().astype(int)
    course = values[moments].astype(np.float64).ravel()
    if not np.isfinite(course).all():
        raise EpisodeError(f"{source.repo_id} episode {index}: {' or '.join(columns)} is not a number in some rows")
    return course


def _scaled(courses: Float64[ndarray, "n d"]) -> Float64[ndarray, "n d"]:
    """In standard deviations of each value over all moments: where a value hardly varies it does not tell."""
    values = courses.reshape(len(courses) * MOMENTS, -1)
    spread = values.std(0)
    return (values / np.where(spread > 0, spread, 1.0)).reshape(len(courses), -1)
