"""What a row of the table is worth: the share that it wins of what exact pictures win over image transforms alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

BASE, BEST = "transforms", "oracle"
RESAMPLED = 2000
SMALLEST_GAIN = 0.05  # of the oracle: below it there is nothing to share

Outcomes = Mapping[str, np.ndarray]  # row -> whether solved [seeds, cameras, tasks], of one group of cameras


@dataclass(frozen=True)
class Figure:
    """A mean and its 95 % interval."""

    value: float
    low: float
    high: float


def success(outcomes: Outcomes, row: str, seed: int = 0) -> Figure:
    """Success of a row over the cameras of a group; the interval is over tasks and seeds."""
    means = [_mean(outcomes[row], *choice) for choice in _choices(outcomes, [row], seed)]
    return Figure(float(outcomes[row].mean()), *_interval(means))


def share(outcomes: Outcomes, row: str, seed: int = 0) -> Figure | None:
    """The row's share of the oracle's gain; None where the oracle gains too little or either is not measured.

    Tasks are drawn once for all rows, which solve the same ones; seeds row by row.
    """
    rows = [row, BASE, BEST]
    if any(name not in outcomes for name in rows):
        return None
    mine, base, best = (outcomes[name].mean() for name in rows)
    if best - base < SMALLEST_GAIN:
        return None
    shares = []
    for drawn in zip(*(_choices(outcomes, [name], seed, number) for number, name in enumerate(rows)), strict=True):
        low, high = (_mean(outcomes[name], *choice) for name, choice in zip(rows[1:], drawn[1:], strict=True))
        if high - low >= SMALLEST_GAIN:
            shares.append((_mean(outcomes[row], *drawn[0]) - low) / (high - low))
    return Figure(float((mine - base) / (best - base)), *_interval(shares))


def _choices(
    outcomes: Outcomes, rows: Sequence[str], seed: int, number: int = 0
) -> Sequence[tuple[np.ndarray, np.ndarray]]:
    """Tasks and seeds of each resampling: the tasks are the same for every `number`."""
    seeds, _, tasks = outcomes[rows[0]].shape
    of_tasks, of_seeds = np.random.default_rng([seed, 0]), np.random.default_rng([seed, 1, number])
    return [(of_tasks.integers(tasks, size=tasks), of_seeds.integers(seeds, size=seeds)) for _ in range(RESAMPLED)]


def _mean(solved: np.ndarray, tasks: np.ndarray, seeds: np.ndarray) -> float:
    return float(solved[seeds][:, :, tasks].mean())


def _interval(values: Sequence[float]) -> tuple[float, float]:
    low, high = np.percentile(values, [2.5, 97.5]) if len(values) else (float("nan"), float("nan"))
    return float(low), float(high)
