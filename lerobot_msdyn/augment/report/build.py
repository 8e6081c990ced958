"""From a finished run to report.html beside its output.

The page is bounded: pictures of at most PICTURED views (half of them the ones with the lowest scores), about 0.5 MB
each, of as many dropped ones, MOST_SHEETS sheets of priors, and page.LISTED rows of text.
"""

import importlib.metadata
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.augment.report.page import LISTED, Origin, Pictures, ViewEntry, page, worst_first
from lerobot_msdyn.augment.report.pictures import (
    CLIP_FRAMES,
    STRIP_FRAMES,
    data_url,
    film,
    full_size,
    heat_map,
    jpeg_url,
    side_by_side,
    spread,
    strip,
)
from lerobot_msdyn.augment.shown import write_jpeg
from lerobot_msdyn.dataset.provenance import CALIBRATION, FOLDER, PREVIEW, RECIPE, SOURCE_VARIANT
from lerobot_msdyn.dataset.read import open_source, read_colour
from lerobot_msdyn.dataset.rows import read_rows
from lerobot_msdyn.dataset.write import NewEpisode

logger = logging.getLogger(__name__)

NAME = "report.html"
PACKAGES = {"lerobot_msdyn": "lerobot_msdyn", "LeRobot": "lerobot"}
PICTURED = 16  # views with pictures
ASSUMED_PROVIDER = "plane"  # of depth
MOST_LINKS = 6  # pictures of a robot's links
MOST_SHEETS = 3  # of priors, of the views with the lowest scores


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
    entries: list[ViewEntry] = []
    places: dict[int, int] = {}  # of those that were kept, the episode of the output
    for entry, index in entries_of(episodes):
        if index is not None:
            places[len(entries)] = index
        entries.append(_without_details(entry))
    output = open_source(source.repo_id, root)
    pictured = _pictured(entries)
    dropped = set([i for i, entry in enumerate(entries) if entry.dropped][:LISTED])
    for i, (entry, _) in enumerate(entries_of(episodes)):
        if i in pictured:
            entries[i] = replace(entry, pictures=_pictures(source, output, places[i], entry))
        elif i in dropped:
            entries[i] = entry
    for i in [i for i, entry in enumerate(entries) if entry.frame is not None][:PICTURED]:
        entries[i] = replace(entries[i], pair=_dropped_pair(source, entries[i]))
    _write_preview(source, output, root, entries, places)
    path = root / NAME
    figures = _figures(episodes, entries, skipped_episodes, seconds)
    origin = _origin(source, root, episodes, entries)
    path.write_text(page(name, figures, entries, skipped, origin), encoding="utf-8")
    return path


def _write_preview(
    source: LeRobotDatasetMetadata,
    output: LeRobotDatasetMetadata,
    root: Path,
    entries: Sequence[ViewEntry],
    places: Mapping[int, int],
) -> None:
    """The picture of the dataset card: the view of median score."""
    ranked = sorted(places, key=lambda i: entries[i].score)
    if ranked:
        middle = ranked[len(ranked) // 2]
        place = places[middle]
        few = spread(int(output.episodes[place]["length"]), STRIP_FRAMES).tolist()
        write_jpeg(root / PREVIEW, strip(*_recorded_and_new(source, output, place, entries[middle], few)))


def _origin(
    source: LeRobotDatasetMetadata, root: Path, episodes: Iterable[NewEpisode], entries: Sequence[ViewEntry]
) -> Origin:
    """What to say of how the dataset in `root` was made."""
    said: dict[str, None] = {}
    for episode in episodes:
        if episode.provenance.variant != SOURCE_VARIANT:
            for name, priors in episode.provenance.priors.items():
                said[f"{name}: {_source_of(priors.get('depth', {}))}"] = None
    versions = [f"{title} {importlib.metadata.version(name)}" for title, name in PACKAGES.items()]
    facts = {
        "source": f"{source.repo_id}, {source.total_episodes} episodes, {source.total_frames} frames",
        "depth": "; ".join(said),
        "made": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, by {', '.join(versions)}",
    }
    assumed = any(entry.assumed for entry in entries)
    return Origin(facts, assumed, _recipe(root), _sheets(entries), _links(root))


def _is_assumed(priors: Mapping[str, Any]) -> bool:
    """Whether depth is that of a plane at an assumed height and tilt, and not under a robot that the joints found."""
    return priors.get("depth", {}).get("provider") == ASSUMED_PROVIDER and "robot" not in priors


def _source_of(prior: Mapping[str, str]) -> str:
    """Where a prior is from, and why from there."""
    why = f" ({prior['why']})" if prior.get("why") else ""
    return f"{prior.get('model', prior.get('provider', 'unknown'))}{why}"


def _recipe(root: Path) -> str:
    path = root / RECIPE
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def _sheets(entries: Sequence[ViewEntry]) -> dict[str, str]:
    """Pictures of the priors of the episodes whose views are worst, by what they are of."""
    worst = [entry for entry in worst_first(entries) if entry.sheet is not None]
    paths = {f"episode {entry.episode}, {entry.camera}": entry.sheet for entry in worst}
    shown = [(name, path) for name, path in paths.items() if path is not None and path.is_file()][:MOST_SHEETS]
    return {name: jpeg_url(path.read_bytes()) for name, path in shown}


def _dropped_pair(source: LeRobotDatasetMetadata, entry: ViewEntry) -> str | None:
    """The frame that was rendered of a dropped view, beside the recorded one."""
    after = None if entry.frame is None else cv2.imread(str(entry.frame))
    if after is None:
        return None
    rows = read_rows(source, entry.episode)
    before = read_colour(source, entry.episode, entry.camera, rows, [len(rows) // 2])[0].numpy()
    return data_url(side_by_side(before, after[..., ::-1]))


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
                entry = ViewEntry(
                    episode.source_index,
                    origin.variant,
                    camera,
                    amounts,
                    view,
                    rejected,
                    dropped,
                    sheet=episode.sheets.get(camera),
                    frame=episode.frames.get(camera),
                    assumed=_is_assumed(origin.priors.get(camera, {})),
                )
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
    length = int(output.episodes[index]["length"])
    few, many = (spread(length, count).tolist() for count in (STRIP_FRAMES, CLIP_FRAMES))
    middle = length // 2
    wanted = sorted({*few, *many, middle})
    before, after = (
        dict(zip(wanted, frames, strict=True)) for frames in _recorded_and_new(source, output, index, entry, wanted)
    )
    moving = film([before[t] for t in many], [after[t] for t in many])
    scores = entry.view.get("scores")
    heat = None if scores is None else data_url(heat_map(after[middle], scores["heat"]))
    return Pictures(
        data_url(strip([before[t] for t in few], [after[t] for t in few])),
        data_url(moving),
        len(many),
        moving.shape[1] / len(many) / moving.shape[0],
        heat,
        data_url(full_size(before[middle])),
        data_url(full_size(after[middle])),
    )


def _recorded_and_new(
    source: LeRobotDatasetMetadata,
    output: LeRobotDatasetMetadata,
    index: int,
    entry: ViewEntry,
    frames: Sequence[int],
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Some frames [h,w,3], ascending, of a view that was kept, recorded and new."""
    recorded, new = (
        list(read_colour(meta, number, entry.camera, read_rows(meta, number), frames).numpy())
        for meta, number in ((source, entry.episode), (output, index))
    )
    return recorded, new


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
