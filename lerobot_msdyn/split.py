"""Command line: the episodes to train and to evaluate on, such that no recording is on both sides.

lerobot-train $(python -m lerobot_msdyn.split --root FOLDER) --dataset.repo_id=NAME --dataset.root=FOLDER ...
"""

import logging
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_msdyn.core.cli import EXIT_OK, parse_config, run_command
from lerobot_msdyn.core.errors import ConfigError, DatasetError
from lerobot_msdyn.core.fields import between
from lerobot_msdyn.core.files import check_root
from lerobot_msdyn.dataset.named import lerobot_home

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

logger = logging.getLogger(__name__)

COMMAND = "python -m lerobot_msdyn.split"
DIGITS = 6  # of the share that is passed to LeRobot


@dataclass
class SplitConfig:
    """`python -m lerobot_msdyn.split`: flags for lerobot-train that hold out whole recordings."""

    # Dataset, by its name in LeRobot's home (alias: --repo).
    repo_id: str = ""
    # Exact folder of the dataset.
    root: Path | None = None
    # Share of each task's recordings that is held out.
    eval_split: float = between(0.2, 10**-DIGITS, 1 - 10**-DIGITS)


@dataclass(frozen=True)
class Split:
    """Episodes on either side, and what makes LeRobot's trainer split them there."""

    train: list[int]
    evaluation: list[int]
    episodes: list[int]  # for --dataset.episodes: per task, first those to train on
    eval_split: float  # for --dataset.eval_split

    @property
    def arguments(self) -> list[str]:
        """Flags for `lerobot-train`."""
        return [
            f"--dataset.episodes=[{','.join(map(str, self.episodes))}]",
            f"--dataset.eval_split={self.eval_split:.{DIGITS}f}",
        ]


def split_by_source(root: Path, share: float = 0.2) -> Split:
    """Hold out the last recordings of each task, with all that was rendered from them.

    LeRobot holds out the last `ceil(eval_split * episodes)` of each task in the order in which they are listed. So
    episodes are listed with those to hold out last, and `eval_split` is chosen such that it comes out. Where
    meta/msdyn is there, only recorded episodes are evaluated on. Some episodes may be on neither side.

    Args:
        root: a dataset's folder: an output, or what LeRobot's tools made of outputs and sources.
        share: of each task's recordings.

    Raises:
        DatasetError: no task has two recordings.
        ConfigError: the share is not between 0 and 1.
    """
    from lerobot_msdyn.dataset.lineage import provenance_of, recordings
    from lerobot_msdyn.dataset.provenance import SOURCE_VARIANT
    from lerobot_msdyn.dataset.read import open_source

    if not 0 < share < 1:
        raise ConfigError(f"eval_split is {share}; expected a share between 0 and 1")
    meta = open_source(root.name, root)
    rows = provenance_of(meta)
    recorded = {i for i in range(meta.total_episodes) if rows is None or rows[i]["variant"] == SOURCE_VARIANT}
    group = recordings(meta)
    sides = [_sides(episodes, group, recorded, share) for episodes in _by_task(meta, group)]
    shares = [len(held) / (len(train) + len(held)) for train, held in sides if train]
    if not shares:
        raise DatasetError(f"{root}: no task has two recordings, so none can be held out")
    eval_split = math.floor(min(shares) * 10**DIGITS) / 10**DIGITS
    sides = [(train, held[: _held_out(len(train), eval_split)]) for train, held in sides]
    return Split(
        train=sorted(index for train, _ in sides for index in train),
        evaluation=sorted(index for _, held in sides for index in held),
        episodes=[index for train, held in sides for index in train + held],
        eval_split=eval_split,
    )


def _by_task(meta: "LeRobotDatasetMetadata", group: list[int]) -> list[list[int]]:
    """Episodes by the task under which LeRobot counts them, that of a recording's first episode."""
    tasks: dict[str, list[int]] = {}
    for index, task in enumerate(meta.episodes["tasks"]):
        tasks.setdefault(task[0] if task else "", []).append(index)
    split = {index: task for task, episodes in tasks.items() for index in episodes}
    if any(split[index] != split[first] for index, first in enumerate(group)):
        raise DatasetError(f"{meta.root}: episodes of one recording have different tasks")
    return list(tasks.values())


def _sides(episodes: list[int], group: list[int], recorded: set[int], share: float) -> tuple[list[int], list[int]]:
    """The episodes of one task to train on and those to hold out."""
    recordings_of_task = list(dict.fromkeys(group[index] for index in episodes))
    count = max(1, round(share * len(recordings_of_task)))
    held = set(recordings_of_task[len(recordings_of_task) - count :])
    out = [index for index in episodes if group[index] in held]
    return [index for index in episodes if group[index] not in held], [i for i in out if i in recorded] or out


def _held_out(train: int, eval_split: float) -> int:
    """How many episodes behind `train` others LeRobot holds out as exactly these."""
    count = 1
    while math.ceil((train + count) * eval_split) > count:
        count += 1
    return count


def run(arguments: list[str]) -> int:
    """Print flags for LeRobot's trainer; returns the exit code."""
    config = parse_config(SplitConfig, arguments, {"repo": "repo_id"}, command=COMMAND)
    if config.root is None and not config.repo_id:
        raise ConfigError(f"which dataset? {COMMAND} --repo NAME or --root FOLDER (see --help)")
    root = config.root or lerobot_home() / config.repo_id
    check_root(root)
    from lerobot_msdyn.dataset.metadata import described  # needs neither LeRobot nor torch, which take long

    described(root.name, root)
    split = split_by_source(root, config.eval_split)
    logger.info("%d episodes to train on, %d to evaluate on", len(split.train), len(split.evaluation))
    sys.stdout.write(" ".join(split.arguments) + "\n")
    return EXIT_OK


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
