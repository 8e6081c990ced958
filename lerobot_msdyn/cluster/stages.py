"""The three steps of the job, each as what one task does; any of them may be killed, and done again without harm.

background  once: what all episodes share (where cameras stand, which of them, their background), checked and kept
episodes    by rank: all new episodes of a shard of the source, each kept as it is finished
merge       once: all of them as one dataset, with statistics, card and report, read again and moved to its place
"""

import contextlib
import importlib.metadata
import json
import logging
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.augment.failures import ranges
from lerobot_msdyn.augment.job import Opened, checked_output, deliver, describe_opened, open_job
from lerobot_msdyn.augment.robot_cameras import calibrated_before
from lerobot_msdyn.augment.run import attempts, prepared, problems_of, share_background
from lerobot_msdyn.augment.run_identity import describe_run
from lerobot_msdyn.augment.workers import Work, terse
from lerobot_msdyn.cluster.shards import frames_to_render, shard
from lerobot_msdyn.cluster.task import RESULT, Job, Place, errors_in, write_json
from lerobot_msdyn.core.errors import OutputError, WorkerError
from lerobot_msdyn.dataset.provenance import CALIBRATION, read_provenance
from lerobot_msdyn.dataset.read import open_source
from lerobot_msdyn.dataset.staging import (
    BACKGROUNDS,
    FAILED,
    FINISHED,
    RUN,
    SHARED,
    Staging,
    differences,
    published_before,
)
from lerobot_msdyn.dataset.video import quiet_encoders
from lerobot_msdyn.dataset.write import OutputDataset
from lerobot_msdyn.priors.fetch import place_of
from lerobot_msdyn.priors.models import MODELS

logger = logging.getLogger(__name__)

BACKGROUND, EPISODES, MERGE = "background", "episodes", "merge"
FINISHED_FILE = f"{FINISHED}.safetensors"
COMMON = (RUN, f"{BACKGROUNDS}.safetensors", f"{SHARED}.safetensors", CALIBRATION)  # what the first step leaves
DATASET = "dataset"  # of a store: where the output is put
CHOSEN = ("episodes", "rendered", "cameras")  # of what is opened, chosen by the first step
OPTIONAL = ("transformers", "timm", "onnxruntime", "pycolmap", "yourdfpy", "gsplat")  # decide on what `auto` takes
SHOWN_ERRORS = 5


class Progress(NamedTuple):
    """What a task has done with one episode."""

    episode: int
    frames: int
    failure: str  # empty: it is finished


def background(job: Job) -> None:
    """Find out what all episodes share, and keep it.

    Raises:
        OutputError: the work folder holds another run, or the output cannot be made.
        DatasetError: the source cannot be used.
    """
    config, place = _begin(job, BACKGROUND)
    place.pull(*COMMON)
    staging = Staging(place.new_root)
    try:
        opened = open_job(config, config.root)
        staging.agree(describe_opened(config, opened.source))
        output = checked_output(config, opened, job.new_repo_id, place.new_root, staging, replaces=True)
        with terse(config):
            config, _ = prepared(opened, config, output)
            share_background(_work(opened, config, output))
        found = {name: getattr(opened, name) for name in CHOSEN} | what_is_here()
        staging.keep(SHARED, lambda: found)
    finally:
        staging.close(stopped=True)
    place.push(*reversed(COMMON))


def episodes(job: Job, rank: int, world_size: int) -> Iterator[Progress]:
    """Work on a shard; yields as each of its episodes is done, those that were before left out.

    Raises:
        WorkerError: the background step is not done, or this node would make something else than that node.
    """
    config, place = _begin(job, f"{EPISODES}_{rank:05d}")
    place.pull(*COMMON)
    staging = Staging(place.new_root, lock=False)
    shared = _shared(staging)
    source = open_source(config.repo_id, config.root, config.tolerance_s)
    _check_same(staging, shared, source, config)
    opened = Opened(source, **{name: shared[name] for name in CHOSEN})
    mine = [opened.episodes[i] for i in shard(frames_to_render(opened), rank, world_size)]
    done = finished_in(place)
    unfinished = [index for index in mine if index not in done]
    output = OutputDataset(source, job.new_repo_id, place.new_root, staging, nvenc=config.nvenc, replaces=True)
    config = calibrated_before(config, staging.folder / CALIBRATION)
    work = _work(opened, config, output)
    with terse(config):
        for index, failure in attempts(
            work, unfinished, problems_of(source, unfinished, work.rendered, work.cameras, config)
        ):
            if failure is not None:
                logger.error("skipped: %s", failure)
                output.episode(index).say_failed(failure)
            name = f"{EPISODES}/{index:06d}"
            place.push(name, last=FINISHED_FILE if failure is None else FAILED)
            place.forget(name)
            yield Progress(index, int(source.episodes[index]["length"]), failure or "")


def merge(job: Job, errors: dict[int, str] | None = None) -> None:
    """Make the output of what is finished; does nothing where it is there already.

    Episodes that failed are left out and named, and their work folder stays: the same command tries them again.

    Args:
        job: what is made.
        errors: what tasks left that ended without being done, to be named where their episodes lack.

    Raises:
        WorkerError: episodes are neither finished nor failed.
        OutputError: something else lies in the output's place.
    """
    config, place = _begin(job, MERGE)
    place.pull(*COMMON, EPISODES)
    published_before(place.new_root)
    if not (place.folder / RUN).exists():
        if place.new_root.exists():
            logger.info("%s is finished", place.new_root)
            return
        raise WorkerError(_no_background(place.folder))
    begun = (place.folder / RUN).stat().st_mtime
    with Staging(place.new_root) as staging:
        shared = _shared(staging)
        wanted: list[int] = shared["episodes"]
        finished = set(_finished_here(staging.folder))
        failures = {index: staging.episode(index).failed() for index in wanted if index not in finished}
        lacking = [index for index, reason in failures.items() if not reason]
        if lacking:
            raise WorkerError(_lacking(lacking, errors or {}))
        if _has_all(place.new_root, staging.run_digest(), finished):
            logger.info("%s has all that is finished", place.new_root)
            return
        source = open_source(config.repo_id, config.root, config.tolerance_s)
        opened = Opened(source, **{name: shared[name] for name in CHOSEN})
        output = OutputDataset(source, job.new_repo_id, place.new_root, staging, nvenc=config.nvenc, replaces=True)
        text, left_out = deliver(config, opened, output, failures, lambda: time.time() - begun, keep_failed=True)
    if place.store is not None:
        place.store.remove(DATASET)
        place.store.put(place.new_root, DATASET)
        text = text.replace(str(place.new_root), f"{place.store.url}/{DATASET}")
        if not failures:
            for name in (EPISODES, *COMMON):
                place.store.remove(name)
    write_json(f"{job.logs}/{RESULT}", {"text": text, "left_out": left_out})


def finished_in(place: Place) -> set[int]:
    """The episodes that are finished, wherever."""
    if place.store is None:
        return _finished_here(place.folder)
    return {int(Path(name).parent.name) for name in place.store.names(f"{EPISODES}/*/{FINISHED_FILE}")}


def what_is_here() -> dict[str, list[str]]:
    """The learned models and optional libraries of this node, by which providers are chosen where settings say auto."""
    libraries = []
    for name in OPTIONAL:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            libraries.append(f"{name} {importlib.metadata.version(name)}")
    models = [name for name, model in MODELS.items() if place_of(model) is not None]
    return {"models": models, "libraries": libraries}


def _begin(job: Job, task: str) -> tuple[AugmentConfig, Place]:
    quiet_encoders()
    torch.set_num_threads(job.threads)
    return job.config(), job.place(task)


def _work(opened: Opened, config: AugmentConfig, output: OutputDataset) -> Work:
    return Work(
        opened.source, frozenset(opened.rendered), opened.cameras, config, output, progress=lambda what, share: None
    )


def _finished_here(folder: Path) -> set[int]:
    return {int(path.parent.name) for path in folder.glob(f"{EPISODES}/*/{FINISHED_FILE}")}


def _no_background(folder: Path) -> str:
    return f"{folder}: the step {BACKGROUND} is not done; its log says why. Give the same command again"


def _shared(staging: Staging) -> dict[str, Any]:
    if not staging.has(SHARED):
        raise WorkerError(_no_background(staging.folder))
    shared: dict[str, Any] = staging.kept_value(SHARED)
    return shared


def _check_same(
    staging: Staging, shared: dict[str, Any], source: LeRobotDatasetMetadata, config: AugmentConfig
) -> None:
    """Whether this node makes what the first one makes: by settings, device, versions, models and libraries.

    Digests of the source's files are left out: the first step has taken them, and they are as large as the source.
    """
    before = json.loads((staging.folder / RUN).read_text())
    changes = differences(before | {"source": {}}, describe_run(source.root, [], config) | {"source": {}})
    changes += differences({name: shared[name] for name in ("models", "libraries")}, what_is_here())
    if changes:
        raise WorkerError(
            f"{socket.gethostname()} would make something else than the node of the step {BACKGROUND}: "
            f"{'; '.join(changes)}. Give all nodes the same installation, device and models (python -m "
            "lerobot_msdyn.models fetch NAME, or HF_HOME in a folder that all see)"
        )


def _lacking(lacking: list[int], errors: dict[int, str]) -> str:
    named = "; ".join(f"task {rank}: {message}" for rank, message in list(errors.items())[:SHOWN_ERRORS])
    more = f", and {len(errors) - SHOWN_ERRORS} more tasks" if len(errors) > SHOWN_ERRORS else ""
    why = f"{named}{more}" if named else "their tasks were killed, most often for want of memory or time"
    return f"{len(lacking)} episodes are not done ({ranges(lacking)}): {why}. The same command goes on from there"


def _has_all(new_root: Path, run: str, finished: set[int]) -> bool:
    """Whether the output is there and has all finished episodes.

    Raises:
        OutputError: something else is there.
    """
    if not new_root.exists():
        return False
    rows = read_provenance(new_root, ("run",)) or []
    if {row.get("run") for row in rows} != {run}:
        raise OutputError(f"{new_root} exists already; remove it or choose another --new_repo_id or --new_root")
    return {row["source_episode"] for row in rows} >= finished


def step_errors(logs: str) -> dict[int, str]:
    """What the tasks of a step left that ended without being done."""
    try:
        return errors_in(logs)
    except (OSError, ValueError):
        return {}
