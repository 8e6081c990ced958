"""The three steps as datatrove's, which its executors run by rank."""

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Generator, Iterator
from typing import TYPE_CHECKING, Any

from datatrove.pipeline.base import PipelineStep
from datatrove.utils.logging import logger as engine_log

from lerobot_msdyn.cluster.task import read_job, say_error
from lerobot_msdyn.core.cli import quiet_libraries
from lerobot_msdyn.core.errors import MsdynError, WorkerError, first_line, one_line

if TYPE_CHECKING:
    from lerobot_msdyn.cluster.stages import Progress

PACKAGE = "lerobot_msdyn"
MODULE = f"{PACKAGE}.cluster.rank"
BARE = "--bare"  # for that module: without an executor, which the process that starts it has


class JobStep(PipelineStep):
    """One of the steps in `stages`, of a job that is described in a file."""

    type = PACKAGE

    def __init__(self, job_file: str, step: str, logs: str, *, apart: bool = False) -> None:
        """Describe it.

        Args:
            job_file: what `Job.write` wrote.
            step: its name in `stages`.
            logs: datatrove's folder of this step.
            apart: whether its work is done by a process of its own: where the engine's own process has threads that a
                fork does not survive, or would wait for ever for one that is killed.
        """
        self.name = step
        super().__init__()
        self.job_file, self.step, self.logs, self.apart = job_file, step, logs, apart

    def run(self, data: Any = None, rank: int = 0, world_size: int = 1) -> Generator[Any, None, None]:
        """Do one task of it.

        Raises:
            MsdynError: it could not be done; the reason is left in the folder of logs as well.
        """
        say_error(self.logs, rank, "")
        try:
            with self.track_time("task"):
                if self.apart:
                    _work_apart([self.job_file, self.step, self.logs, str(rank), str(world_size)])
                else:
                    with logged_by_the_engine():
                        for done in work(self.job_file, self.step, rank, world_size):
                            self.stat_update("episodes failed" if done.failure else "episodes finished", unit="task")
                            self.stat_update("frames", value=done.frames, unit="task")
        except Exception as error:
            say_error(self.logs, rank, one_line(error) if isinstance(error, MsdynError) else first_line(error))
            raise
        yield from data or ()


def work(job_file: str, step: str, rank: int, world_size: int) -> "Iterator[Progress]":
    """Do one task of a step; yields as episodes are done."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as commands do, before torch is loaded
    from lerobot_msdyn.cluster import stages

    job = read_job(job_file)
    if step == stages.BACKGROUND:
        stages.background(job)
    elif step == stages.MERGE:
        stages.merge(job, stages.step_errors(f"{job.logs}/{stages.EPISODES}_{job.tasks}"))
    else:
        yield from stages.episodes(job, rank, world_size)


def _work_apart(arguments: list[str]) -> None:
    command = [sys.executable, "-m", MODULE, *arguments, BARE]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    said = ""
    assert process.stdout is not None
    for line in process.stdout:
        said = line.decode(errors="replace").rstrip()
        engine_log.info("{}", said)
    code = process.wait()
    if code < 0:
        raise WorkerError(killed(-code))
    if code != 0:
        raise WorkerError(said.removeprefix("error: ") or f"exit code {code}")


def killed(number: int) -> str:
    """What to say of a process that a signal ended."""
    return (
        f"killed by {signal.Signals(number).name}, most often for want of memory; what is finished is kept: the same "
        "command goes on from there"
    )


class _Forward(logging.Handler):
    """Python's log records, said by the engine's log, which has a file for each task."""

    def emit(self, record: logging.LogRecord) -> None:
        engine_log.opt(exception=record.exc_info).log(record.levelname, "{}", record.getMessage())


class logged_by_the_engine:  # noqa: N801  # a context, used as a function
    """Within, what this package logs goes to the engine's log."""

    def __enter__(self) -> None:
        self._before = logging.root.handlers, logging.root.level
        logging.root.handlers, logging.root.level = [_Forward()], logging.INFO
        quiet_libraries()

    def __exit__(self, *_: object) -> None:
        logging.root.handlers, logging.root.level = self._before
