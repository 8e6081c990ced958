"""Command line: write meta/msdyn/ for a dataset that LeRobot's tools made of others; they leave it behind.

python -m lerobot_msdyn.carry --root MERGED --sources '[FOLDER, FOLDER]'
"""

import logging
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_msdyn.core.cli import EXIT_OK, parse_config, run_command
from lerobot_msdyn.core.errors import ConfigError, DatasetError
from lerobot_msdyn.core.files import check_root

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

logger = logging.getLogger(__name__)

COMMAND = "python -m lerobot_msdyn.carry"


@dataclass
class CarryConfig:
    """`python -m lerobot_msdyn.carry`: meta/msdyn/ for what LeRobot's tools made of other datasets."""

    # Exact folder of the dataset that gets it.
    root: Path | None = None
    # Exact folders of the datasets that it was made from, e.g. '[A, B]'.
    sources: list[Path] = field(default_factory=list)


Mark = tuple[str | None, str]  # digests of an episode's rows and of the statistics of its pictures


def carry_provenance(root: Path, sources: list[Path]) -> int:
    """Write meta/msdyn/ of a dataset whose episodes come from others; returns how many there are.

    Episodes are recognised by their rows and by the statistics of their pictures. Those of a dataset without
    meta/msdyn/ are recordings of their own.

    Raises:
        DatasetError: an episode is in none of the sources, or in several that say different things about it.
    """
    from lerobot_msdyn.dataset.card import write_card
    from lerobot_msdyn.dataset.provenance import write_rows
    from lerobot_msdyn.dataset.read import open_source

    rows_by_mark: dict[Mark, list[dict[str, Any]]] = {}
    origin: dict[str | None, dict[str, Any]] = {}
    for source in sources:
        for mark, row in _known_episodes(source):
            rows_by_mark.setdefault(mark, []).append(row)
            if row.get("recipe_sha256"):
                origin[mark[0]] = {name: row[name] for name in ("source_repo_id", "source_episode")}
    meta = open_source(root.name, root)
    rows = []
    for index, mark in enumerate(_marks(meta)):
        candidates = [row | origin.get(mark[0], {}) for row in rows_by_mark.get(mark, [])]
        candidates = [row for row in candidates if row.get("recipe_sha256")] or candidates
        if len({(row["source_repo_id"], row["source_episode"], row["variant"]) for row in candidates}) != 1:
            where = "several of the sources, which disagree about it" if candidates else "none of the sources"
            raise DatasetError(f"{root}: episode {index} is in {where}: {', '.join(map(str, sources))}")
        rows.append(candidates[0])
    names = sorted({name for row in rows for name in row} - {"episode_index"})
    write_rows(root, [{name: row.get(name) for name in names} for row in rows])
    write_card(root, meta.repo_id)
    return len(rows)


def _known_episodes(root: Path) -> list[tuple[Mark, dict[str, Any]]]:
    """By what an episode is recognised, and what is known about it."""
    from lerobot_msdyn.dataset.lineage import provenance_of
    from lerobot_msdyn.dataset.provenance import SOURCE_VARIANT
    from lerobot_msdyn.dataset.read import open_source

    meta = open_source(root.name, root)
    rows = provenance_of(meta) or [
        {"source_repo_id": meta.repo_id, "source_episode": index, "variant": SOURCE_VARIANT}
        for index in range(meta.total_episodes)
    ]
    return list(zip(_marks(meta), rows, strict=True))


def _marks(meta: "LeRobotDatasetMetadata") -> list[Mark]:
    from lerobot_msdyn.dataset.lineage import picture_digests, row_digests

    return list(zip(row_digests(meta), picture_digests(meta), strict=True))


def run(arguments: list[str]) -> int:
    """Write meta/msdyn/ and say so; returns the exit code."""
    config = parse_config(CarryConfig, arguments, {}, command=COMMAND)
    if config.root is None or not config.sources:
        raise ConfigError(f"which datasets? {COMMAND} --root FOLDER --sources '[FOLDER, ...]' (see --help)")
    roots = (config.root, *config.sources)
    for root in roots:
        check_root(root)
    from lerobot_msdyn.dataset.metadata import described  # needs neither LeRobot nor torch, which take long

    for root in roots:
        described(root.name, root)
    count = carry_provenance(config.root, config.sources)
    sys.stdout.write(f"meta/msdyn/ of {count} episodes written to {config.root}\n")
    return EXIT_OK


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
