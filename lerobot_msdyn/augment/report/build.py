"""From a finished run to report.html beside its output.

The page is bounded: pictures of at most PICTURED views (half of them the ones with the lowest scores), about 0.4 MB
each, and page.LISTED rows of text.
"""

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.augment.report.page import LISTED, Pictures, ViewEntry, page
from lerobot_msdyn.augment.report.pictures import (
    CLIP_FRAMES,
    STRIP_FRAMES,
    data_url,
    film,
    heat_map,
    spread,
    strip,
)
from lerobot_msdyn.dataset.provenance import CALIBRATION, FOLDER, SOURCE_VARIANT
from lerobot_msdyn.dataset.read import open_source, read_colour
from lerobot_msdyn.dataset.rows import read_rows
from lerobot_msdyn.dataset.write import NewEpisode

logger = logging.getLogger(__name__)

NAME = "report.html"
PICTURED = 16  # views with pictures
MOST_LINKS = 6  # pictures of a robot's links


def write_report(
    source: LeRobotDatasetMetadata,
    root: Path,
    name: str,
    episodes: Sequence[NewEpisode],
    skipped: Sequence[str],
    skipped_episodes: int,
    seconds: float,
) -> Path:
    """Write the report of a dataset that was just written; returns its path.

    Args:
        source: the dataset whose episodes were re-rendered.
        root: folder of the new dataset.
        name: its name in the page.
        episodes: all of a run in order, the dropped ones among them.
        skipped: why source episodes were left out, one line per reason.
        skipped_episodes: how many were.
        seconds: what the run took.
    """
    entries = [_without_details(entry) for entry, _ in entries_of(episodes)]
    output = open_source(source.repo_id, root)
    pictured = _pictured(entries)
    dropped = set([i for i, entry in enumerate(entries) if entry.dropped][:LISTED])
    for i, (entry, index) in enumerate(entries_of(episodes)):
        if i in pictured and index is not None:
            entries[i] = replace(entry, pictures=_pictures(source, output, index, entry))
        elif i in dropped:
            entries[i] = entry
    path = root / NAME
    figures, links = _figures(episodes, entries, skipped_episodes, seconds), _links(root)
    path.write_text(page(name, figures, entries, skipped, links), encoding="utf-8")
    return path


def _links(root: Path) -> dict[str, str]:
    """The pictures of a robot's links over the video, by name."""
    paths = sorted((root / FOLDER / CALIBRATION).glob("*.png"))[:MOST_LINKS]
    pictures = {path.stem: cv2.imread(str(path)) for path in paths}
    return {name: data_url(picture[..., ::-1].copy()) for name, picture in pictures.items() if picture is not None}


def entries_of(episodes: Iterable[NewEpisode]) -> Iterator[tuple[ViewEntry, int | None]]:
    """All views, each with its episode of the output if it was kept."""
    index = 0
    for episode in episodes:
        origin = episode.provenance
        if origin.variant != SOURCE_VARIANT:
            for camera, view in origin.gate["views"].items():
                amounts, rejected = origin.perturbation[camera], origin.gate["rejected"]
                view = view | origin.views[camera]
                dropped = bool(episode.dropped)
                entry = ViewEntry(episode.source_index, origin.variant, camera, amounts, view, rejected, dropped)
                yield entry, None if dropped else index
        index += not episode.dropped


def _without_details(entry: ViewEntry) -> ViewEntry:
    """Without what only views that are shown at length tell, most of its memory: there may be thousands."""
    if entry.scores is None:
        return entry
    return replace(entry, view=entry.view | {"scores": entry.scores | {"heat": [], "frames": []}})


def _pictured(entries: Sequence[ViewEntry]) -> set[int]:
    """Which views get pictures: those with the lowest scores, and the first ones."""
    kept = [i for i, entry in enumerate(entries) if not entry.dropped]
    worst = set(sorted(kept, key=lambda i: entries[i].score)[: PICTURED // 2])
    return worst | set([i for i in kept if i not in worst][: PICTURED - len(worst)])


def _pictures(source: LeRobotDatasetMetadata, output: LeRobotDatasetMetadata, index: int, entry: ViewEntry) -> Pictures:
    """Strip, clip and map of one view, from the two datasets' own pictures."""
    before, after = (
        read_colour(meta, number, entry.camera, read_rows(meta, number)).numpy()
        for meta, number in ((source, entry.episode), (output, index))
    )
    few, many = (spread(len(before), count) for count in (STRIP_FRAMES, CLIP_FRAMES))
    moving = film(list(before[many]), list(after[many]))
    scores = entry.view.get("scores")
    heat = None if scores is None else data_url(heat_map(after[len(after) // 2], scores["heat"]))
    return Pictures(
        data_url(strip(list(before[few]), list(after[few]))),
        data_url(moving),
        len(many),
        moving.shape[1] / len(many) / moving.shape[0],
        heat,
    )


def _figures(
    episodes: Sequence[NewEpisode], entries: Sequence[ViewEntry], skipped_episodes: int, seconds: float
) -> dict[str, str]:
    """What the page says at its top."""
    scores = [entry.score for entry in entries if not entry.dropped and np.isfinite(entry.score)]
    fitting: dict[tuple[int, str], float] = {}
    new = dropped = rejected = 0
    judging_s = 0.0
    for episode in episodes:
        if episode.provenance.variant == SOURCE_VARIANT:
            continue
        new += not episode.dropped
        dropped += bool(episode.dropped)
        rejected += len(episode.provenance.gate["rejected"])
        judging_s += episode.seconds["judging"]
        fitting |= {(episode.source_index, key): s for key, s in episode.seconds.items() if key.startswith("fitting ")}
    return {
        "new episodes": str(new),
        "dropped by the gate": str(dropped),
        "source episodes skipped": str(skipped_episodes),
        "samples rejected": str(rejected),
        "expected quality, median": f"{np.median(scores):.1f} dB" if scores else "not judged",
        "all in all": _time(seconds),
        "in fitting": _time(sum(fitting.values())),
        "in judging": _time(judging_s),
    }


def _time(seconds: int | float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.1f} min"
