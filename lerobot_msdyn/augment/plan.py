"""What a run would do, for `--dry_run`: a little of the work is done, and the rest is judged by it."""

from pathlib import Path

from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.augment.cost import (
    PROBE_FRAMES,
    first_speeds,
    frames_of,
    predicted_bytes,
    predicted_scene_bytes,
    predicted_seconds,
)
from lerobot_msdyn.augment.failures import ranges
from lerobot_msdyn.augment.job import Opened
from lerobot_msdyn.augment.workers import terse, threads_of_one, workers_for
from lerobot_msdyn.dataset.select import colour_cameras, is_wrist_camera

TIME_RANGE = (0.75, 1.5)  # of the predicted time; chosen by hand, not measured over many runs
DISK_RANGE = (0.8, 1.25)  # of the predicted size; likewise


def plan(opened: Opened, config: AugmentConfig, place: Path) -> str:
    """Episodes, cameras, time and disk of a run whose output would be `place`.

    Raises:
        EpisodeError: none of the episodes can be read.
        PriorError: a prior was demanded and cannot be had.
    """
    source, episodes, rendered, cameras = opened.source, opened.episodes, opened.rendered, opened.cameras
    frames, frames_seen = frames_of(source, episodes), frames_of(source, rendered)
    variants, copies = config.variants if cameras else 0, int(config.include_source)
    count = workers_for(config, frames_seen, len(rendered))
    with threads_of_one(count), terse(config):
        speeds = first_speeds(source, rendered, cameras, config)
    seconds = predicted_seconds(speeds, source, rendered, config, count)
    scenes = predicted_scene_bytes(speeds, source, rendered, config) if config.save_scenes else 0.0
    disk = predicted_bytes(speeds, source, episodes, rendered, config) + scenes
    each = "the recorded one and " if config.include_source else ""
    new = f"for each that is read: {each}{variants} new"
    if config.episodes_share < 1:
        new = f"{variants} new for each of {len(rendered)}, chosen to cover what was recorded: {ranges(rendered)}"
    written, pictures = len(episodes) * copies + len(rendered) * variants, frames_seen * variants * len(cameras)
    by = "one process" if count == 1 else f"{count} processes"
    kept = f", {_range(scenes / 1e6, DISK_RANGE)} MB of it saved scenes" if scenes else ""
    rows = [
        ("reads", f"{_count(len(episodes), 'episode')}, {frames} frames, of {source.repo_id}"),
        *(("camera", line) for line in camera_lines(source, cameras, config)),
        ("writes", f"{_count(written, 'episode')}, {frames * copies + frames_seen * variants} frames, to {place}"),
        ("", f"{new}; {pictures} new pictures"),
        ("time", f"{_duration(seconds)} on this machine by {by}, judging by {PROBE_FRAMES} frames of one episode"),
        ("disk", f"{_range(disk / 1e6, DISK_RANGE)} MB{kept}; about twice as much until the run ends"),
    ]
    return "plan (nothing is written):\n" + "".join(f"  {name:7s}{text}\n" for name, text in rows)


def camera_lines(source: LeRobotDatasetMetadata, cameras: list[str], config: AugmentConfig) -> list[str]:
    """For each colour camera whether it is re-rendered, or copied and why."""
    return [f"{key}: {_fate(key, cameras, config)}" for key in colour_cameras(source)]


def _fate(key: str, cameras: list[str], config: AugmentConfig) -> str:
    if key in cameras:
        return "re-rendered"
    if is_wrist_camera(key):
        return "copied as recorded: by its name it moves with the robot"
    return "copied as recorded: " + ("not among --cameras" if config.cameras is not None else "it moves")


def _duration(seconds: float) -> str:
    """A range of time in words."""
    low, high = (share * seconds for share in TIME_RANGE)
    for unit, length in (("hours", 7200.0), ("minutes", 120.0)):
        if high >= length:
            return f"{_range(seconds / (length / 2), TIME_RANGE)} {unit}"
    return f"{low:.0f} to {high:.0f} seconds"


def _range(value: float, shares: tuple[float, float]) -> str:
    """A range about a value, without more figures than it is known to."""
    low, high = (share * value for share in shares)
    digits = 1 if high < 10 else 0
    return f"{low:.{digits}f} to {high:.{digits}f}"


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"
