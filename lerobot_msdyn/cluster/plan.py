"""What tasks there are, which of them are done, and what each costs."""

import statistics
from dataclasses import replace
from pathlib import Path

import draccus

from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.augment.cost import (
    first_speeds,
    predicted_background_seconds,
    predicted_episode_seconds,
    predicted_output_bytes,
)
from lerobot_msdyn.augment.job import Opened, chosen_episodes, place_of
from lerobot_msdyn.augment.workers import most_workers, terse, threads_of_one
from lerobot_msdyn.cluster.config import ClusterConfig, job_settings
from lerobot_msdyn.cluster.shards import frames_to_render, shards
from lerobot_msdyn.cluster.stages import finished_in
from lerobot_msdyn.cluster.task import Job
from lerobot_msdyn.core.plugins import imported_plugins
from lerobot_msdyn.core.processes import cores
from lerobot_msdyn.dataset.read import open_source

SHOWN = 16  # tasks, each by a line


def job_of(config: ClusterConfig) -> Job:
    """What tasks are told of a command.

    Raises:
        OutputError: a dataset cannot have the name of the output.
    """
    settings = job_settings(config)
    new_repo_id, new_root = place_of(settings)
    new_root = new_root.absolute()
    root = None if config.root is None else config.root.absolute()
    settings = replace(settings, root=root, new_root=new_root, restart=False, dry_run=False)
    logs = config.logs or (f"{config.store.rstrip('/')}/logs" if config.store else f"{new_root}_logs")
    return Job(
        plugins=imported_plugins(),
        settings=draccus.encode(settings),
        new_repo_id=new_repo_id,
        new_root=str(new_root),
        folder=str(Path.cwd()),
        logs=logs if "://" in logs else str(Path(logs).absolute()),
        store=config.store or "",
        tasks=config.tasks,
        processes=config.processes,
        threads=max(1, cores() // at_once(config)) if config.executor == "local" else config.cpus_per_task,
    )


def at_once(config: ClusterConfig) -> int:
    """Tasks at the same time on this machine."""
    return config.at_once or min(config.tasks, most_workers(job_settings(config)))


def unfinished_ranks(job: Job) -> list[int]:
    """Tasks with episodes that are not finished, whatever their completion markers say."""
    config = job.config()
    source = open_source(config.repo_id, config.root, config.tolerance_s)
    opened = Opened(source, *chosen_episodes(source, config), cameras=[])
    finished = finished_in(job.place("command"))
    return [
        rank
        for rank, places in enumerate(shards(frames_to_render(opened), job.tasks))
        if any(opened.episodes[place] not in finished for place in places)
    ]


def cost_table(opened: Opened, config: AugmentConfig, job: Job) -> str:
    """Episodes, frames, minutes and disk of each task, judging by a little of the work on this machine."""
    source = opened.source
    with threads_of_one(max(1, job.processes)), terse(config):
        speeds = first_speeds(source, opened.rendered, opened.cameras, config)
    background_s = predicted_background_seconds(speeds, source, opened.rendered, config, job.processes)
    frames, rendered = frames_to_render(opened), set(opened.rendered)
    lines, minutes = [], []
    for rank, places in enumerate(shards(frames, job.tasks)):
        mine = [opened.episodes[place] for place in places]
        new = [index for index in mine if index in rendered]
        minutes.append(predicted_episode_seconds(speeds, source, new, config, job.processes) / 60)
        disk = predicted_output_bytes(source, mine, new, config) / 1e6
        count = sum(frames[place] for place in places)
        lines.append(f"{rank:6d}  {len(mine):8d}  {count:9d}  {minutes[-1]:8.1f}  {disk:8.1f}\n")
    some = f" of {len(rendered)} of them" if len(rendered) < len(opened.episodes) else ""
    more = f"   ...  and {len(lines) - SHOWN} more\n" if len(lines) > SHOWN else ""
    return (
        f"{source.repo_id}: {len(opened.episodes)} episodes, {sum(frames)} frames{some}, re-rendering "
        f"{', '.join(opened.cameras) or 'nothing'}; {job.tasks} tasks of {job.processes} "
        f"{'process' if job.processes == 1 else 'processes'}\n"
        f"before them, the background: {background_s / 60:.1f} minutes\n"
        f"  task  episodes     frames   minutes   MB disk\n{''.join(lines[:SHOWN])}{more}"
        f"minutes of a task: median {statistics.median(minutes):.1f}, at most {max(minutes):.1f}; of all "
        f"{sum(minutes):.1f}, judging by a few frames and steps on this machine\n"
    )
